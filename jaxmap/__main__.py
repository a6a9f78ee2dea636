"""`python -m jaxmap`."""

import sys

from jaxmap.commands.main import main

sys.exit(main())
