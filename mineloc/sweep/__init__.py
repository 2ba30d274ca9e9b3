"""What is done to one sweep before anybody interprets it: filters, deskew, voxel grid."""

from mineloc.sweep.deskew import deskew_constant_twist, deskew_poses
from mineloc.sweep.range_filter import within_range
from mineloc.sweep.voxel_grid import first_in_voxels, voxel_centroids

__all__ = ["deskew_constant_twist", "deskew_poses", "first_in_voxels", "voxel_centroids", "within_range"]
