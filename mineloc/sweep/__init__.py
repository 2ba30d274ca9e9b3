"""What is done to one sweep before anybody interprets it: filters, deskew, voxel grid."""
