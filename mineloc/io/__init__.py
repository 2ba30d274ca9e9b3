"""The door: recordings, flights, trajectories and clouds, one format a module; alone knows mcap and rosbags."""
