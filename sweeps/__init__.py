"""What to run, where results live, and the command line `fic-sweep`."""
