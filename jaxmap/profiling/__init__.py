"""Where the time of a run goes: traces of its steps, told by the stages of the algorithm."""
