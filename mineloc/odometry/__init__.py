"""Front ends: from sweeps to poses, keyframes and relative pose factors."""
