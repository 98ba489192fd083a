"""Verify answers by local features: their matches, inliers, and the camera pose they imply."""
