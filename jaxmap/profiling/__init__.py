"""Where the time of a run goes: traces of its steps, summed by the stages of the algorithm."""
