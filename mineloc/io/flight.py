"""The canonical flight file: what `ingest` and `simulate` write and every other stage reads."""

from mineloc.io.flight_reader import FlightReader
from mineloc.io.flight_writer import FlightWriter

__all__ = ["FlightReader", "FlightWriter"]
