"""Writes the page of a study as static files, for participants who cannot reach the machine of the study.

    tokens = export_bundle(study, store, Path("out/bundle"), participants=20)    # one personal link each

Any web server of static files can serve the folder. The browser of a participant stores the answers. The participant
downloads them as a file, and `brewster study import` adds the file to the study. The folder contains no name of a
method, dataset or source file, and neither the correct choice of a catch trial nor an answer.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any, Final

from brewster.files import atomic_path
from brewster.user_study.assignment import Trial
from brewster.user_study.create import require_empty
from brewster.user_study.store import AnswerStore
from brewster.user_study.study import PICTURES_FOLDER, Study

PARTICIPANTS_FOLDER: Final = "participants"
_PAGE_FOLDER: Final = Path(__file__).parent / "page"
_COPIED: Final = ("style.css", "study.css", "study.js", "study_bundle.js", "pan_zoom.js", "icon.svg")
_SIDES: Final = ("photo", "left", "right")
_HEAD: Final = """\
<meta http-equiv="Content-Security-Policy"
 content="default-src 'self'; img-src 'self' data:; base-uri 'none'; form-action 'none'">
<meta name="study-bundle" content="static">
"""
_PRIVACY: Final = """\
<p>Your browser keeps your answers until you download them as a file and send it to the person who runs the study.
      They are not sent automatically. The web server that you loaded this page from may store your network address and
      the time.</p>
"""


def export_bundle(study: Study, store: AnswerStore, out: Path, *, participants: int) -> list[str]:
    """Writes the page, the pictures and the trials of new participants into the folder `out`.

    The participants take the next places in the assignment of the study, as participants of the server do.
    Returns the token of each: a personal link is the address of the folder, followed by `?p=TOKEN`. Raises
    OutputError if `out` is not empty, or it or the answers cannot be written, and BrewsterError if a picture
    of the study is missing or changed.
    """
    require_empty(out)
    study.verify_pictures()
    with atomic_path(out) as folder:
        for name in (PICTURES_FOLDER, PARTICIPANTS_FOLDER):
            (folder / name).mkdir(parents=True)
            (folder / name / "index.html").touch()  # else many servers list the files, and so the tokens
        _write_page(folder)
        tokens = [store.admit_exported() for _ in range(participants)]
        for token in tokens:
            participant = store.participant(token, exported=True)
            assert participant
            trials, practice = participant.trials, participant.practice
            for name in {getattr(trial, side) for trial in (*trials, practice) for side in _SIDES}:
                target = folder / PICTURES_FOLDER / Path(name).name
                if not target.exists():
                    shutil.copyfile(study.picture_file(name), target)
            text = json.dumps(
                {  # without the correct choices of catch trials
                    "consent": study.description.consent,
                    "trials": [_describe_trial(study, trial) for trial in trials],
                    "practice": _describe_trial(study, practice) | {"expected": practice.expected},
                }
            )
            (folder / PARTICIPANTS_FOLDER / f"{token}.json").write_text(text, "utf-8")
    return tokens


def _write_page(folder: Path) -> None:
    for name in _COPIED:
        shutil.copyfile(_PAGE_FOLDER / name, folder / name)
    for source, target in (("study.html", "index.html"), ("privacy.html", "privacy.html")):
        text = (_PAGE_FOLDER / source).read_text("utf-8")
        text = text.replace('"/page/', '"').replace('"/privacy"', '"privacy.html"')
        text = text.replace("<title>", f"{_HEAD}<title>").replace("<!-- bundle -->", _PRIVACY)
        (folder / target).write_text(text, "utf-8")


def _describe_trial(study: Study, trial: Trial) -> dict[str, Any]:
    photo = study.picture(trial.photo)
    names = {side: Path(getattr(trial, side)).name for side in _SIDES}
    return names | {"width": photo.width, "height": photo.height}
