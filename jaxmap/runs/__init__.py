"""What the commands do with files: plans, run folders, logs and outputs."""
