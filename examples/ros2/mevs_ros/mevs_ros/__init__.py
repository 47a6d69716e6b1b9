"""A ROS 2 node that recognises objects by chosen views of a depth camera."""
