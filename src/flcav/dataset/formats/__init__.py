"""Other people's dataset formats: exported to all of `EXPORTERS`, read from KITTI."""
