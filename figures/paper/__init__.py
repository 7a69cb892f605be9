"""One script for each figure of the paper: plot(data) is pure, main() simulates and saves."""
