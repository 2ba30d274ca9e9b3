"""The methods, each readable in a minute."""
