"""Verification of answers: matched local features, their inliers, and the pose that they show."""
