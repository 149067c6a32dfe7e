"""Input and output: atomic files, npz, YAML, zarr, images, videos, reader sandbox, terminal."""
