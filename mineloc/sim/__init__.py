"""Mines, sensors and flights that are made up: everything a real recording holds, and the truth with it."""
