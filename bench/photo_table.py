"""Writes the table of the training photos, which is part of the package, and the section
Photographs of the model card.

BREWSTER_DATA=../shared/data .venv/bin/python bench/photo_table.py

Reads photos/manifest.csv and the prepared photos, and writes
src/brewster/render/environments/training_photos.csv and the section in
src/brewster/separation/models/weights/compact.md. Run it again when the photos or the card change.
"""

import csv
import os
import re
from collections import Counter, defaultdict
from pathlib import Path

from brewster.photo import Photo
from brewster.render.environments.training_photos import COLUMNS, TABLE, difference_hash, read_table
from brewster.separation.models import zoo

DATA = Path(os.environ.get("BREWSTER_DATA", "../shared/data")) / "photos"
SHORTER = {  # the columns source and origin have the rest
    r"\(Open Images V4[;,].*": "(Open Images V4)",
    r": CC BY 2.0 per the Open Images index; .*": "",
}
SECTION = """\
## Photographs

`training_photos.csv` in `brewster.render.environments` lists {count:,} photos with source, licence,
author and origin, as far as they are known. The weights of version 2 were trained on 1,330 of them,
those of tone and hints on all that are not held out. The numbers of photos, by licence and source:

{lines}

Open Images photos: the table has their ids, under which the index of Open Images
(`images-with-rotation.csv`) names the author and the page. Authors of COCO photos are named by the
Flickr address in the column licence. Of {anonymous} other CC BY photos, no author is known.
"""


def row(entry, hashes):
    """Returns the row of the package for a row of manifest.csv. `hashes` has the hashes that are
    known already.
    """
    short = dict(entry, file=entry["file"].removeprefix("permissive/"))
    for pattern, text in SHORTER.items():
        short |= {
            column: re.sub(pattern, text, short[column]) for column in ("licence", "attribution")
        }
    known = hashes.get(short["file"])
    if entry["origin"] and not known:
        known = f"{difference_hash(Photo.open(DATA / entry['file'])):016x}"
    return short | {"difference_hash": known or ""}


def licence(photo):
    """Returns the licence without the author and the file that states it, which the table has."""
    text = re.sub(r"[;,(].*", "", photo.licence).strip()
    same = {
        "CC0": "CC0 1.0",
        "public domain": "Public domain",
        "CC0 / public domain": "public domain / CC0",
    }
    return same.get(text, text)


def section(photos):
    """Returns the section of the model card."""
    counts = defaultdict(Counter)
    for photo in photos:
        counts[licence(photo)][re.sub(r"@[0-9a-f]{12}$", "", photo.source)] += 1
    by_size = sorted(counts.items(), key=lambda item: -item[1].total())
    lines = [
        f"- {terms}, {sources.total():,}: "
        f"{', '.join(f'{source} {count}' for source, count in sources.most_common())}"
        for terms, sources in by_size
    ]
    return SECTION.format(
        count=len(photos), lines="\n".join(lines), anonymous=sum(map(is_anonymous, photos))
    )


def is_anonymous(photo):
    names_author = photo.attribution or re.search("https?://|author [A-Za-z]{3}", photo.licence)
    return photo.licence.startswith("CC BY") and (
        not names_author or "author CC BY" in photo.licence
    )


def main():
    known = {photo.file: photo.difference_hash for photo in read_table()} if TABLE.exists() else {}
    with (DATA / "manifest.csv").open(newline="", encoding="utf-8") as file:
        rows = [row(entry, known) for entry in csv.DictReader(file)]
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows(sorted(rows, key=lambda row: row["file"]))
    card = zoo.MODELS["compact"].path.with_suffix(".md")
    text = re.sub(r"## Photographs\n.*?(?=## )", "", card.read_text("utf-8"), flags=re.DOTALL)
    card.write_text(text.replace("## Scores\n", f"{section(read_table())}\n## Scores\n"), "utf-8")


if __name__ == "__main__":
    main()
