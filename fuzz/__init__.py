"""Feed Barsight with damaged and hostile input, and hold each answer against docs/threat-model.md.

    python -m fuzz --minutes 5 --seed 1

A checkout's tool: it is no part of the installed package.
"""

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # read when NumPy is loaded: a fork must not lose its threads
