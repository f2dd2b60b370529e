"""Requests for rooms: floor, doors and windows, ceiling, wishes and given objects."""

from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PlainValidator, ValidationError, model_validator

from sceneprior.core.checked import fault_of, shown
from sceneprior.core.classes import UnknownClassError
from sceneprior.core.classes import label_set as label_set_of
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, SceneObject
from sceneprior.core.scene_json import MOST_OBJECTS, ObjectEntry, check_box, read_object, unit_guess
from sceneprior.lifted.requests.checks import check_request
from sceneprior.lifted.requests.floors import Floor, read_floor
from sceneprior.lifted.requests.openings import MOST_OPENINGS, WantedOpening, read_openings
from sceneprior.lifted.requests.sentence import read_sentence
from sceneprior.lifted.requests.wishes import OPENINGS, Conditions, Wishes, read_wishes

HIGHEST_M = 20.0
"""Highest ceiling that can be requested."""


def _plain(value: Any) -> Any:
    """Convert a part of a request to plain JSON data."""
    if isinstance(value, Opening):
        return _plain(value._asdict())
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(each) for each in value]
    return value if isinstance(value, str | float | int | bool | None) else str(value)


def _read_objects(objects: Any) -> tuple[SceneObject, ...]:
    """Given objects, from Python or as entries of a scene's JSON."""
    if not isinstance(objects, Sequence) or len(objects) > MOST_OBJECTS:
        raise InputError(
            f"The objects are {shown(objects)}; expected a list, at most {MOST_OBJECTS} long."
        )
    found = [
        each
        if isinstance(each, SceneObject)
        else read_object("The request", ObjectEntry.model_validate(each))
        for each in objects
    ]
    for item in found:
        check_box("The request", item.label, item.center_m, item.size_m)
    return tuple(found)


def _part(schema: Any) -> PlainValidator:
    """A part that is kept as plain data, with the type that its JSON Schema shows."""
    return PlainValidator(_plain, json_schema_input_type=schema)


class RoomRequest(BaseModel):
    """A request as users write it: in Python, as options, in the browser or in a file.

    The parts are kept as they were written; what they say is read once, when the request is made.
    `conditions` completes this by what a prior knows.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    floor: Annotated[Any, _part(str | list[tuple[float, float]] | None)] = None
    """`4x3` (metres along x and z), or corners [x, z] in order; see `read_floor`."""
    openings: Annotated[Any, _part(str | list[dict[str, Any] | str] | None)] = None
    """Doors and windows, such as `door,window@north`; see `read_openings`."""
    ceiling_m: Annotated[float, Field(strict=True)] | None = None
    """Height of the ceiling."""
    want: Annotated[
        Any, _part(str | dict[str, int | str | list[dict[str, str | int | None]]] | None)
    ] = None
    """Wishes: a sentence (`read_sentence`), or a mapping or text with numbers of objects by class
    (`read_wishes`)."""
    objects: Annotated[
        tuple[SceneObject, ...],
        PlainValidator(_read_objects, json_schema_input_type=list[ObjectEntry]),
    ] = ()
    """Given objects, in the coordinates of the floor; they stay as they are."""

    @classmethod
    def of(cls, where: str | None = None, /, **parts: Any) -> "RoomRequest":
        """Make a request from its parts.

        Args:
            where: File of the parts, for messages.

        Raises:
            InputError: a part is invalid; the message says what was expected.
        """
        try:
            return cls(**parts)
        except ValidationError as error:
            (first, *_) = error.errors(include_url=False)
            if isinstance(found := first.get("ctx", {}).get("error"), InputError):
                if where is None:
                    raise found from None
                raise InputError(f"{where}: {str(found).removeprefix('The request: ')}") from None
            start = (
                "The request"
                if where is None
                else f"{where} is not a request, which docs/requests.md describes"
            )
            raise InputError(f"{start}: {fault_of(error)}.") from None

    @model_validator(mode="after")
    def _read(self) -> "RoomRequest":
        """Read all parts that need no prior, so that mistakes are found at once."""
        _ = self.outline_m, self.wanted_openings, self.wishes
        if self.outline_m is None and any(isinstance(e, Opening) for e in self.wanted_openings):
            raise InputError(
                "An opening has corners, which lie on the walls of a floor; give the floor, too, "
                "or write door or window@north."
            )
        height_m = self.ceiling_m
        if height_m is not None and not 1.0 <= height_m <= HIGHEST_M:
            guess = f" {unit_guess(height_m)}" if height_m > HIGHEST_M else ""
            raise InputError(
                f"The ceiling is {height_m:g} m high; expected 1 to {HIGHEST_M:g} m above the "
                f"floor.{guess}"
            )
        return self

    @cached_property
    def outline_m(self) -> np.ndarray | None:
        """Corners (x, z) of the floor; None if it is left open."""
        return None if self.floor is None else read_floor(self.floor)

    @cached_property
    def wanted_openings(self) -> tuple[Opening | WantedOpening, ...]:
        """The doors and windows."""
        return () if self.openings is None else read_openings(self.openings)

    @cached_property
    def wishes(self) -> Wishes | None:
        """The wishes; None if they are a sentence, which is read by what a prior knows."""
        return Wishes() if self.want is None else read_wishes(self.want)

    def parts(self) -> dict[str, Any]:
        """The parts that are set, as arguments of `Prior.sample`."""
        found = {name: getattr(self, name) for name in RoomRequest.model_fields}
        return {name: part for name, part in found.items() if part not in (None, [], ())}

    def conditions(
        self,
        known: Sequence[str],
        label_set: str,
        most: int,
        stays: bool = False,
        may_meet: Collection[frozenset[str]] = (),
    ) -> "Conditions":
        """The request as a prior understands it.

        Without given objects, the floor is moved so that the centre of its bounding box is the
        origin, unless it `stays`. Doors and windows that the wishes need beyond the listed ones are
        added.

        Args:
            known: Classes that the prior draws.
            label_set: Name of the prior's label set.
            most: Largest number of objects in a room.
            may_meet: Pairs of classes whose boxes may intersect.

        Raises:
            InputError: the prior does not understand a part, or two parts contradict each other.
        """
        outline_m, openings, wishes = self.outline_m, self.wanted_openings, self.wishes
        if wishes is None:
            sentence = read_sentence(self.want, known, label_set)
            if sentence.floor is not None:
                if outline_m is not None:
                    raise InputError(
                        f"The floor is given, and the sentence asks for {sentence.floor} m; leave "
                        "one out."
                    )
                outline_m = read_floor(sentence.floor)
            listed = list(openings)
            for each in read_openings(sentence.openings):
                # A door of the sentence may be a listed one.
                fits = [o for o in listed if each in (o, WantedOpening(o.kind))]
                if fits:
                    listed.remove(fits[0])
                else:
                    openings += (each,)
            wishes = sentence.wishes
        for kind in OPENINGS:
            least, _ = wishes.bounds.get(kind, (0, 0))
            lacking = min(least, MOST_OPENINGS + 1) - sum(each.kind == kind for each in openings)
            openings += read_openings([kind] * max(lacking, 0))
        if outline_m is not None and not (self.objects or stays):
            middle = (outline_m.min(axis=0) + outline_m.max(axis=0)) / 2
            outline_m = outline_m - middle
            openings = tuple(
                each._replace(
                    start_m=tuple((each.start_m - middle).tolist()),
                    end_m=tuple((each.end_m - middle).tolist()),
                )
                if isinstance(each, Opening)
                else each
                for each in openings
            )
        classes = tuple(label_set_of(label_set))
        for item in self.objects:
            if item.label not in classes[1:]:
                raise UnknownClassError(item.label, known)
        floor = None if outline_m is None else Floor(outline_m)
        found = Conditions(classes, floor, openings, self.ceiling_m, wishes, self.objects)
        check_request(found, known, most, may_meet)
        return found


class RequestFile(RoomRequest):
    """The JSON of a request; `RequestFile.model_json_schema()` is its JSON Schema."""

    format: Literal["sceneprior-request"]
    version: Literal[1]
