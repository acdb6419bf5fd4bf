"""Dataset formats of the field: export to each of `export.FORMATS`, and reading of KITTI."""
