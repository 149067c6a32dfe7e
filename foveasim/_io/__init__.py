"""Input and output: atomic files, npz, YAML, zarr, images, videos, sandbox, terminal."""
