"""A stand-in of open3d, which the scripts here import and do not use; its own needs libraries of the system."""
