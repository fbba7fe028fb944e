"""What a participant's browser talks to: consent, the pictures of a trial, answers.

    create_app(study_router(study, Store(study)), limits=limits, index="study.html")

Nothing here names a method, a file or a dataset: a picture is a trial's left, right or photo, and only who holds the
personal link of that trial gets it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal, final

from fastapi import APIRouter, Body
from fastapi import Path as FromPath
from fastapi.responses import Response
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException

from brewster.user_study import assignment
from brewster.user_study.assignment import Choice
from brewster.user_study.store import AnswerStore, Participant
from brewster.user_study.study import Study
from brewster.web.application import page_response

_CACHED: Final = {"Cache-Control": "private, max-age=86400, immutable"}
_NOT_CACHED: Final = {"Cache-Control": "no-store"}


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Invitation(_Strict):
    """What somebody is told before they take part: the text, and how many trials there are."""

    consent: str
    trials: int
    is_open: bool


class ConsentRequest(_Strict):
    """That somebody takes part."""

    agreed: Literal[True]


class PersonalLink(_Strict):
    """The personal link, from the server's root."""

    link: str


class TrialResponse(_Strict):
    """The first trial without an answer, from 0, and the size of its pictures in px; no trial where all are answered."""

    trial: int | None
    trials: int
    width: int | None = None
    height: int | None = None


class AnswerRequest(_Strict):
    """An answer, and for how many seconds the pictures were seen."""

    trial: Annotated[int, Field(ge=0)]
    choice: Choice
    seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]


class AnswerResponse(_Strict):
    """What is on the disk now, which is the first answer that came, and what is next."""

    kept: Choice
    next: TrialResponse


Token = Annotated[str, FromPath(max_length=64)]
Side = Literal["photo", "left", "right"]


def study_router(
    study: Study, store: AnswerStore, *, max_participants: int | None = None, token: str | None = None
) -> APIRouter:
    """The routes of a study that admits at most so many; personal links carry the guard's token, if there is one."""
    routes, router = _StudyRoutes(study, store, max_participants, token), APIRouter(tags=["study"])
    router.get("/invitation")(routes.invitation)
    router.post("/participants", status_code=201)(routes.admit)
    router.get("/s/{participant_token}", include_in_schema=False)(routes.begin)
    router.get("/s/{participant_token}/link")(routes.link)
    router.get("/s/{participant_token}/trial")(routes.next_trial)
    router.get("/s/{participant_token}/pictures/{trial}/{side}", response_class=Response)(routes.picture)
    router.post("/s/{participant_token}/answers")(routes.answer)
    return router


@final
@dataclass(frozen=True)
class _StudyRoutes:
    """What the routes do, each in a thread, as the disk is waited for."""

    study: Study
    store: AnswerStore
    max_participants: int | None
    token: str | None

    def invitation(self) -> Invitation:
        """What the study is about."""
        description = self.study.description
        is_open = self.max_participants is None or self.store.count_participants() < self.max_participants
        return Invitation(
            consent=description.consent, trials=description.pairs + description.catches, is_open=is_open
        )

    def admit(self, _agreement: Annotated[ConsentRequest, Body()]) -> PersonalLink:
        """Admits somebody who agrees to take part, and gives them a link of their own."""
        participant_token = self.store.admit(max_participants=self.max_participants)
        if participant_token is None:
            raise HTTPException(403, "the study has all the participants that it needs; thank you for coming")
        return self._link(participant_token)

    def begin(self, participant_token: Token) -> Response:
        """The page behind a personal link; where nobody has it, the same page says so."""
        response = page_response("study.html")
        response.status_code = 404 if self.store.participant(participant_token) is None else 200
        return response

    def link(self, participant_token: Token) -> PersonalLink:
        """The personal link, whole: the page's own address has lost the guard's token."""
        self._participant(participant_token)
        return self._link(participant_token)

    def next_trial(self, participant_token: Token, response: Response) -> TrialResponse:
        """The first trial without an answer."""
        response.headers.update(_NOT_CACHED)
        return self._next(self._participant(participant_token))

    def picture(self, participant_token: Token, trial: int, side: Side) -> Response:
        """A picture of a trial."""
        shown = _trial(self._participant(participant_token), trial)
        try:
            data = self.study.picture_file(getattr(shown, side)).read_bytes()
        except (
            FileNotFoundError
        ) as error:  # it does not come back by itself: the page must not ask again and again
            raise HTTPException(
                410, "a picture is missing on the server; please tell whoever runs the study"
            ) from error
        return Response(data, media_type="image/png", headers=_CACHED)

    def answer(self, participant_token: Token, answer: Annotated[AnswerRequest, Body()]) -> AnswerResponse:
        """Keeps an answer on the disk. The first one to a trial stays: sent again, it changes nothing."""
        participant = self._participant(participant_token)
        _trial(participant, answer.trial)
        stored = self.store.record_answer(participant, answer.trial, answer.choice, seconds=answer.seconds)
        return AnswerResponse(kept=stored, next=self._next(participant))

    def _link(self, participant_token: str) -> PersonalLink:
        return PersonalLink(link=f"/s/{participant_token}" + (f"?token={self.token}" if self.token else ""))

    def _participant(self, participant_token: str) -> Participant:
        participant = self.store.participant(participant_token)
        if participant is None:
            raise HTTPException(
                404, "nobody has this link; check that it is whole, or begin at the first page"
            )
        return participant

    def _next(self, participant: Participant) -> TrialResponse:
        trial, count = self.store.next_trial(participant), len(participant.trials)
        if trial is None:
            return TrialResponse(trial=None, trials=count)
        photo = self.study.picture(participant.trials[trial].photo)
        return TrialResponse(trial=trial, trials=count, width=photo.width, height=photo.height)


def _trial(participant: Participant, trial: int) -> assignment.TrialDraw:
    if not 0 <= trial < len(participant.trials):
        raise HTTPException(404, f"there is no trial {trial}; load the page again")
    return participant.trials[trial]
