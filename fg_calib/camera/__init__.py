"""Images of a calibration board: corners, poses of the board in the camera's frame, and the camera itself."""
