"""Maps ScanNet's raw categories to classes by its label table."""

import csv
from dataclasses import dataclass
from pathlib import Path

from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import stuff_of

LABEL_SET = "scannet"
SHELL = frozenset(
    ["wall", "floor", "ceiling", "door", "window", "blinds", "floor mat", "mirror", "picture"]
)
"""NYU40 classes of the room itself. They have id 0 in the images, because they surround all
furniture and rarely occlude it."""


@dataclass(frozen=True)
class Labels:
    """Classes of the annotators' raw categories."""

    nyu40: dict[str, str]
    """NYU40 class by raw category, both in lower case."""
    source: str

    def knows(self, category: str) -> bool:
        """Test whether the table lists a raw category."""
        return _tidy(category) in self.nyu40

    def label(self, category: str) -> str:
        """Class in the label set `scannet`; `void` for anything outside its 19 classes."""
        name = self.nyu40.get(_tidy(category), "")
        return name if name in label_set(LABEL_SET) else "void"

    def is_shell(self, category: str) -> bool:
        """Test whether this is a part of the room, such as a wall, rather than furniture."""
        return self.nyu40.get(_tidy(category), "") in SHELL

    def stuff(self, category: str) -> int:
        """Index into `STUFF`; 0 for furniture, and for parts of the room without such a class."""
        return stuff_of(self.nyu40.get(_tidy(category), ""))


def read_labels(path: Path) -> Labels:
    """Read `scannetv2-labels.combined.tsv`; of a repeated category, the last row wins."""
    path = Path(path)
    try:
        with path.open(encoding="utf-8", newline="") as file:
            # Some categories contain a literal quotation mark (inches).
            rows = list(csv.reader(file, delimiter="\t", quoting=csv.QUOTE_NONE))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"The label table {path} cannot be read ({error}); "
            "--labels names ScanNet's scannetv2-labels.combined.tsv."
        ) from None
    columns = [name.strip().lower() for name in rows[0]] if rows else []
    if "raw_category" not in columns and {"category", "nyu40class"} <= set(columns):
        raise InputError(
            f"{path} is the label table of ScanNet's first release; give the second one's, "
            "scannetv2-labels.combined.tsv, with --labels: it works for scans of either."
        )
    if "raw_category" not in columns or "nyu40class" not in columns:
        raise InputError(
            f"{path} has no columns raw_category and nyu40class (it begins with "
            f"{', '.join(columns[:4]) or 'nothing'}); --labels names ScanNet's "
            "scannetv2-labels.combined.tsv, which is tab separated."
        )
    raw, nyu = columns.index("raw_category"), columns.index("nyu40class")
    meanings = {_tidy(row[raw]): _tidy(row[nyu]) for row in rows[1:] if len(row) > max(raw, nyu)}
    if not meanings:
        raise InputError(f"{path} lists no categories; download the label table again.")
    return Labels(meanings, path.name)


def _tidy(text: str) -> str:
    return text.strip().lower()
