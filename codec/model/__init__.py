"""The data model that every stage shares: attributes, Gaussians, groups of frames, rotations, cameras."""
