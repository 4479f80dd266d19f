"""What a model may lack: extensions (rows of one table), their predicted gains, comparison, and the search.

``discover`` fits the user's model, ranks all extensions by a score test, fits the best few beside the best structures,
and compares them by what they predict of held-out pieces. It returns ``Structures``: the set that the logs support, and
the posterior of the user's parameters stacked over it.
"""

from typing import TYPE_CHECKING

from sipe_bayes.core.lazy import exports

if TYPE_CHECKING:
    from sipe_bayes.structure.discovery import Restriction as Restriction
    from sipe_bayes.structure.discovery import discover as discover
    from sipe_bayes.structure.extension import Extension as Extension
    from sipe_bayes.structure.extension import Placed as Placed
    from sipe_bayes.structure.state import DiscoverOptions as DiscoverOptions
    from sipe_bayes.structure.structures import StructureRow as StructureRow
    from sipe_bayes.structure.structures import Structures as Structures
else:
    __getattr__, __dir__ = exports(__name__)
