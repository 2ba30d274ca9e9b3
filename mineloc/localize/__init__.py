"""The methods, each readable in a minute; `METHODS` names them."""

from mineloc.localize.method import METHODS as METHODS
