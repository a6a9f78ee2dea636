"""The refinement of a sequence: matches and solutions in turn, from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmap.errors import JaxmapError
from jaxmap.refinement.matching import Search, match_pair
from jaxmap.refinement.rig import Rig, make_rig
from jaxmap.refinement.solve import Prior, Solution, Term, solve
from jaxmap.refinement.terms import linearise, make_setting
from jaxmap.refinement.views import Pinhole, View
