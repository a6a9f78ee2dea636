"""The parts of `octomap_agreement.py`: two maps of the same clouds, where they differ, why, and who is right."""
