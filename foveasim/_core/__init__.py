"""What every part uses: checks of arguments, packed rings, random streams, threads, compiled kernels, provenance."""
