"""Training recipes: one YAML file per algorithm, in the format of rl_zoo3."""
