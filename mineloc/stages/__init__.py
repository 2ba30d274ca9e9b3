"""One function a stage: paths and configuration in, paths out."""
