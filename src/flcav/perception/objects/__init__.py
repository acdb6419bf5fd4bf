"""3D object detection from LiDAR (SECOND)."""
