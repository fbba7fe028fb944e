"""The HTTP API of the user study: consent, the pictures of a trial, answers.

    create_app(study_router(study, AnswerStore(study)), policy=policy, index="study.html")

No response contains the name of a method, file or dataset. A picture is requested by its trial and
its side (`photo`, `left` or `right`), and only with the personal link of the participant.
"""

from dataclasses import dataclass
from typing import Annotated, Final, Literal, final

from fastapi import APIRouter, Body
from fastapi import Path as FromPath
from fastapi.responses import Response
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException

from brewster.evaluation.study import assignment
from brewster.evaluation.study.assignment import Choice
from brewster.evaluation.study.store import AnswerStore, Participant, ViewingConditions
from brewster.evaluation.study.study import Study
from brewster.web.application import page_response


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Invitation(_Strict):
    """The information before the consent: the consent text and the number of trials."""

    consent: str
    trials: int


class ConsentRequest(_Strict):
    """The agreement to take part."""

    agreed: Literal[True]


class PersonalLink(_Strict):
    """The personal link of a participant, relative to the root of the server."""

    link: str


class PracticeTrial(_Strict):
    """The practice trial: the size of its pictures in px, and the choice that is correct. Its
    answer is not stored.
    """

    width: int
    height: int
    expected: Choice


class TrialResponse(_Strict):
    """The first trial without an answer, and the size of its pictures in px.

    `trial` counts from 0 and is None if all trials have answers. `trials` is the number of all
    trials. `practice` is set as long as there is no answer. `last` is the last trial with an
    answer. This answer can be withdrawn.
    """

    trial: int | None
    trials: int
    width: int | None = None
    height: int | None = None
    practice: PracticeTrial | None = None
    last: int | None = None


class AnswerRequest(_Strict):
    """An answer, the seconds for which the pictures were shown, and the viewing conditions."""

    trial: Annotated[int, Field(ge=0)]
    choice: Choice
    seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    conditions: ViewingConditions | None = None


class WithdrawalRequest(_Strict):
    """The trial whose answer is withdrawn. It must be the last trial with an answer."""

    trial: Annotated[int, Field(ge=0)]


class AnswerResponse(_Strict):
    """The stored choice, which is the choice of the first answer to the trial, and the next
    trial.
    """

    kept: Choice
    next: TrialResponse


Token = Annotated[str, FromPath(max_length=64)]
Side = Literal["photo", "left", "right"]
_CAPTIONS: Final = {"photo": "the photo", "left": "result A", "right": "result B"}
"""The pictures of a trial as the page names them."""


def study_router(
    study: Study,
    store: AnswerStore,
    *,
    max_participants: int | None = None,
    token: str | None = None,
) -> APIRouter:
    """Returns the routes of a study. The token of the server is added to personal links."""
    routes = _StudyRoutes(study, store, max_participants, token)
    router = APIRouter(tags=["study"])
    personal = "/s/{participant_token}"
    router.get("/invitation")(routes.invitation)
    router.post("/participants", status_code=201)(routes.admit)
    router.get(personal, include_in_schema=False)(routes.begin)
    router.get(f"{personal}/link")(routes.link)
    router.get(f"{personal}/trial")(routes.next_trial)
    router.get(f"{personal}/pictures/practice/{{side}}", response_class=Response)(
        routes.practice_picture
    )
    router.get(f"{personal}/pictures/{{trial}}/{{side}}", response_class=Response)(routes.picture)
    router.post(f"{personal}/answers")(routes.answer)
    router.post(f"{personal}/withdrawals")(routes.withdraw)
    router.get("/privacy", include_in_schema=False)(routes.privacy)
    return router


@final
@dataclass(frozen=True)
class _StudyRoutes:
    """The handlers of the routes. FastAPI runs them in threads, because they wait for the disk."""

    study: Study
    store: AnswerStore
    max_participants: int | None
    token: str | None

    def invitation(self) -> Invitation:
        """Returns the information that is shown before the consent. If the study is full, the
        status is 403.
        """
        if (
            self.max_participants is not None
            and self.store.count_participants() >= self.max_participants
        ):
            raise self._full()
        description = self.study.description
        return Invitation(
            consent=description.consent, trials=description.pairs + description.catch_trials
        )

    def admit(self, _agreement: Annotated[ConsentRequest, Body()]) -> PersonalLink:
        """Admits a participant who agrees to take part. Returns the personal link."""
        participant_token = self.store.admit(max_participants=self.max_participants)
        if participant_token is None:
            raise self._full()
        return self._link(participant_token)

    def _full(self) -> HTTPException:
        return HTTPException(
            403,
            f"this study has all the participants that it needs ({self.max_participants}); "
            "expected a study with free places; close this page, and thank you for your interest",
        )

    def begin(self, participant_token: Token) -> Response:
        """Returns the page of a personal link. If the link is unknown, the status is 404, and the
        page shows the error.
        """
        response = page_response("study.html")
        response.status_code = 404 if self.store.participant(participant_token) is None else 200
        return response

    def link(self, participant_token: Token) -> PersonalLink:
        """Returns the personal link with the token of the server, which the address of the page no
        longer contains.
        """
        self._participant(participant_token)
        return self._link(participant_token)

    def next_trial(self, participant_token: Token, response: Response) -> TrialResponse:
        """Returns the first trial without an answer."""
        response.headers["Cache-Control"] = "no-store"
        return self._next(self._participant(participant_token))

    def privacy(self) -> Response:
        """Returns the page that lists what the study stores about a participant."""
        return page_response("privacy.html")

    def practice_picture(self, participant_token: Token, side: Side) -> Response:
        """Returns a picture of the practice trial."""
        return self._picture(
            self._participant(participant_token).practice, side, "the practice pair"
        )

    def picture(self, participant_token: Token, trial: int, side: Side) -> Response:
        """Returns a picture of a trial."""
        shown = _trial(self._participant(participant_token), trial)
        return self._picture(shown, side, f"pair {trial + 1}")

    def _picture(self, shown: assignment.Trial, side: Side, pair: str) -> Response:
        try:
            data = self.study.picture_file(getattr(shown, side)).read_bytes()
        except FileNotFoundError as error:
            raise HTTPException(
                410,  # not 500: the page repeats requests that fail with 500 or more
                f"{_CAPTIONS[side]} of {pair} is missing on the server; expected three pictures "
                "for each pair; tell this to the person who runs the study",
            ) from error
        return Response(
            data,
            media_type="image/png",
            headers={"Cache-Control": "private, max-age=86400, immutable"},
        )

    def answer(
        self, participant_token: Token, answer: Annotated[AnswerRequest, Body()]
    ) -> AnswerResponse:
        """Stores an answer. A second answer to a trial changes nothing, unless the first answer was
        withdrawn.
        """
        participant = self._participant(participant_token)
        _trial(participant, answer.trial)
        stored = self.store.record_answer(
            participant,
            answer.trial,
            answer.choice,
            seconds=answer.seconds,
            conditions=answer.conditions,
        )
        return AnswerResponse(kept=stored, next=self._next(participant))

    def withdraw(
        self, participant_token: Token, withdrawal: Annotated[WithdrawalRequest, Body()]
    ) -> TrialResponse:
        """Withdraws the last answer. Returns the trial, which can be answered again."""
        participant = self._participant(participant_token)
        _trial(participant, withdrawal.trial)
        self.store.withdraw_answer(participant, withdrawal.trial)
        return self._next(participant)

    def _link(self, participant_token: str) -> PersonalLink:
        return PersonalLink(
            link=f"/s/{participant_token}" + (f"?token={self.token}" if self.token else "")
        )

    def _participant(self, participant_token: str) -> Participant:
        participant = self.store.participant(participant_token)
        if participant is None:
            raise HTTPException(
                404,
                f"the personal link /s/{participant_token} is unknown; expected a complete link of "
                "this study; check the link, or begin at the start page",
            )
        return participant

    def _next(self, participant: Participant) -> TrialResponse:
        trial, last = self.store.next_and_last_trial(participant)
        response = TrialResponse(trial=trial, trials=len(participant.trials), last=last)
        if trial is not None:
            photo = self.study.picture(participant.trials[trial].photo)
            response.width, response.height = photo.width, photo.height
            if last is None:
                photo = self.study.picture(participant.practice.photo)
                expected = participant.practice.expected
                assert expected, "a practice trial has a correct choice"
                response.practice = PracticeTrial(
                    width=photo.width, height=photo.height, expected=expected
                )
        return response


def _trial(participant: Participant, trial: int) -> assignment.Trial:
    if not 0 <= trial < len(participant.trials):
        raise HTTPException(
            404,
            f"there is no pair {trial + 1}; expected a pair from 1 to {len(participant.trials)}; "
            "load the page again",
        )
    return participant.trials[trial]
