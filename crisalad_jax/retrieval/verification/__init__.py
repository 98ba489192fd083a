"""Verify answers by local features: matches, inliers, and the camera pose that they imply."""
