"""`python -m benchmarks`: `fic-sweep bench` with the peers, and with the same options."""

import sys

from sweeps.cli import main

if __name__ == "__main__":
    sys.argv[1:1] = ["bench", "--peers"]
    main()
