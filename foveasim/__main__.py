"""``python -m foveasim``: the command line."""

from __future__ import annotations

from foveasim.cli import main

if __name__ == "__main__":
    main()
