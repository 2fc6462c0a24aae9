"""One traced program of a step, written in the words of each format."""
