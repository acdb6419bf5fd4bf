"""Operations of networks: sparse convolution, voxelisation, batch normalisation, IoU and non-maximum suppression."""
