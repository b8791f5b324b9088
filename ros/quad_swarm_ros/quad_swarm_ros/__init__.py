"""The nodes are in `quad_swarm.ros`; this package gives them to `ros2 run` and `ros2 launch`."""
