"""nuScenes' tables and files, as nuscenes-devkit reads them: their export (`write`) and reading (`read`).

Caesar et al., "nuScenes", CVPR 2020.
"""
