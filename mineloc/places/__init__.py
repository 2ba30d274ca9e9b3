"""Places: recognising where one has been, from sweeps alone."""
