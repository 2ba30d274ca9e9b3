"""Content-addressed objects, manifests, lineage and locks."""
