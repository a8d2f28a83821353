"""Where a file is that another file names."""

import os
from pathlib import Path


def found_in(named: str | os.PathLike[str], folder: str | os.PathLike[str]) -> str:
    """The absolute path of a file that one in `folder` names.

    A relative path starts in `folder`, or else in the working folder. A file that is not at its
    path any more is looked for beside what names it, so that both can be moved together. One that
    is nowhere stays as it is.
    """
    path, folder = Path(named), Path(folder)
    places = (folder / path, path, folder / path.name)
    return next((os.path.abspath(p) for p in places if os.path.isfile(p)), os.fspath(named))
