"""Rerun recordings; the only room that knows rerun."""
