"""What is simulated: vehicles in a room, whom they hear of, what they believe, how they fly."""
