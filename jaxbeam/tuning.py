"""Identification of models from measured logs, and tuning of controllers: the package `tuning`.

`from jaxbeam import tuning` finds it beside jaxbeam, also where a file `tuning.py` of your own
would be found first.
"""

import sys
from typing import TYPE_CHECKING

from jaxbeam.runtime.packages import own_package

if TYPE_CHECKING:
    from tuning import *  # noqa: F403
else:
    sys.modules[__name__] = own_package("tuning")
