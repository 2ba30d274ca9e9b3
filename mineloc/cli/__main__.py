"""`python -m mineloc.cli`."""

from mineloc.cli import main

main()
