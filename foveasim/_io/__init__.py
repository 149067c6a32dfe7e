"""Reading and writing: atomic files, npz, YAML, zarr, images, one sandbox for untrusted readers, the terminal."""
