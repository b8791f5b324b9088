"""Robots on ROS 2: plans and requests as standard messages, in a namespace for each robot.

ROS 2 is not a dependency: its Python packages come with a distribution, or as wheels on x86-64.
"""
