"""Other people's dataset formats: exported to all of `FORMATS`, read from KITTI."""
