"""The simulated world: vehicles in a room, their communication, their beliefs and their flight."""
