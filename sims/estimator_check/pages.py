"""The results of the check, as the generated part of a page."""

import platform
from collections.abc import Sequence

from .run import Result
from .tables import tables


def page_text(results: Sequence[Result]) -> str:
    """All tables, with the machine and the revision that made them."""
    flown = sorted({result.revision[:12] for result in results if result.revision})
    by = f", revision {', '.join(f'`{r}`' for r in flown)}" if flown else ""
    head = f"{len(results)} settings, on {platform.machine()}{by}.\n\n"
    return head + "\n".join(table.markdown() for table in tables(results))
