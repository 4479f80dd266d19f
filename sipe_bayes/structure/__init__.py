"""What a model may lack: extensions (a file for each kind of site), their predicted gains, comparison, and the search.

``discover`` fits the user's model, ranks all extensions by a score test, fits the best few beside the best structures,
and compares them by what they predict of held-out pieces. It returns ``Structures``: the set that the logs support, and
the posterior of the user's parameters stacked over it.
"""

from sipe_bayes.structure.discover import Restriction, discover
from sipe_bayes.structure.extension import Extension, Placed
from sipe_bayes.structure.state import DiscoverOptions
from sipe_bayes.structure.structures import StructureRow, Structures

__all__ = ["DiscoverOptions", "Extension", "Placed", "Restriction", "StructureRow", "Structures", "discover"]
