"""nuScenes' tables and files, as nuscenes-devkit reads them: written (`write`) and read (`read`).

Caesar et al., "nuScenes", CVPR 2020.
"""
