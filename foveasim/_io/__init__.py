"""Input and output: atomic files, npz, YAML, zarr, images, reader sandbox, terminal."""
