"""Mapping: from placed sweeps and depth images to the map that a survey delivers."""
