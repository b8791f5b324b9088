"""Pictures of flights and tables: plots, animation, the page that replays an episode, TensorBoard's dashboard."""
