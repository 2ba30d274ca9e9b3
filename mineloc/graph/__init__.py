"""The pose factor graph; the only room that knows gtsam."""
