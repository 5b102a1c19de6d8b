"""One heliostat, or an array of them: joints, drives, parameters, armature, tracking."""
