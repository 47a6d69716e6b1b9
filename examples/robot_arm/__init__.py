"""A robot arm with a depth camera recognises what stands on its table: `python -m examples.robot_arm`, simulated by MuJoCo.

The agent decides where to look next among poses that the arm can reach; the arm moves; the camera's image, with the errors of a
real depth camera, becomes the next observation. Needs `pip install mujoco` and, without a display, the system's libegl1.
"""
