"""mineloc: where a drone is in a mine."""

__version__ = "0.1.0"
