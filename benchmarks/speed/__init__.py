"""Speed and memory of the environment, the agents and tracking."""
