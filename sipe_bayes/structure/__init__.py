"""What a model may lack: extensions (a file each), what they promise, their scores, and the search over them.

``discover`` fits the user's model, tests what every extension would add, fits those that promise most, keeps what both
the evidence and held-out pieces of the logs keep, and returns ``Structures``: a distribution over structures, and the
posterior of the user's parameters averaged over it.
"""

from sipe_bayes.structure.discover import Restriction, discover
from sipe_bayes.structure.extension import Extension, Placed
from sipe_bayes.structure.state import DiscoverOptions
from sipe_bayes.structure.structures import StructureRow, Structures

__all__ = ["DiscoverOptions", "Extension", "Placed", "Restriction", "StructureRow", "Structures", "discover"]
