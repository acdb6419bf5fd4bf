"""Export to nuScenes' tables and files, as nuscenes-devkit reads them. Caesar et al., "nuScenes", CVPR 2020."""

from flcav.dataset.formats.nuscenes.write import export_nuscenes

__all__ = ["export_nuscenes"]
