"""python -m pk_jax.cli"""

import sys

from pk_jax.cli import main

sys.exit(main())
