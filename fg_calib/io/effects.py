"""The key `effects` of a robot file: what the arm does beyond its geometry.

```yaml
effects:
  error_curve: {joints: all, knots: 144}
  compliance: {joints: [2, 3], masses: {2: {mass: 12.0, com: [0.2, 0, 0.1]}}, payload: {mass: 2.0, com: [0, 0, 0.05]}}
  harmonics: true                       # defaults of `robot.effects`
  values: {theta2.compliance: 1.2e-5}   # nominal coefficients in SI units, of a calibrated arm
```
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from pydantic import model_validator

from fg_calib.inputs import InputError, as_floats, check_names, check_type, did_you_mean, expect, shown, within
from fg_calib.io.yaml import Number, Positive, Schema, validate
from fg_calib.robot import EFFECT_KINDS, EFFECTS, Effect, Mass, Robot
from fg_calib.robot.effects import GUESS

STANDARD = ("error_curve", "compliance", "harmonics", "gain")
"""What `select` tries where nothing is listed."""

MOST_METRES = 20.0
"""Farthest place of a mass in the frame of its link, [m], whatever the file's unit."""

NO_MASSES = "`masses: free`, or the mass and com of each link"


def select_standard(links: Mapping[Any, Any]) -> dict[str, Any]:
    """What `effects: select` stands for; compliance with known masses, free products without."""
    compliance: Any = True if None in links and links[None]() else {"masses": "free"}
    return dict.fromkeys(STANDARD, True) | {"compliance": compliance, "select": True}


class _Mass(Schema):
    mass: Positive
    com: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _in_metres(self) -> "_Mass":
        if max(map(abs, self.com)) > MOST_METRES:
            raise InputError("com", f"found {shown(self.com)}", f"m, at most {MOST_METRES:g}", "is it in mm?")
        return self


class _Payload(_Mass):
    column: str = ""


def read_effects(given: Mapping[str, Any], place: str, links: Mapping[Any, Any], n_joints: int) -> list[Effect]:
    """The effects that a mapping lists.

    Args:
        given: The mapping.
        place: Its place, for messages.
        links: What masses may be on, joints' numbers or links of a URDF, and what makes a `Mass` of mass and com there;
            None has what makes the masses of its inertials.
        n_joints: Number of joints: the payload is on the last one's frame.

    Raises:
        InputError: An effect or option that there is not, or no masses.
    """
    check_names(place, given, (*EFFECTS, "values", "select"), "key")
    check_type(f"{place}: select", given.get("select", False), bool)
    check_type(f"{place}: values", given.get("values", {}), Mapping[str, Any])
    effects, masses = list[Effect](), None
    loaded = {key: one for key, one in given.items() if isinstance(one, Mapping) and {"masses", "payload"} & one.keys()}
    for key, one in loaded.items():
        masses = masses or _masses(one, f"{place}: {key}", links, n_joints)
    compliance = given.get("compliance")
    gravity = compliance.get("gravity") if isinstance(compliance, Mapping) else None
    gravity = None if gravity == "estimate" else gravity
    for key in (key for key in given if key in EFFECTS and given[key] is not False):
        of, options, here = EFFECTS[key], given[key], f"{place}: {key}"
        names = [f.name for f in fields(of)]  # type: ignore[arg-type]
        options = {} if options is True else options if isinstance(options, Mapping) else {names[0]: options}
        check_names(here, options, [*names, *["payload"] * ("masses" in names)], "key")
        not_given = (("sigma", "estimate"), ("payload", options.get("payload")))
        options = dict(one for one in options.items() if one not in not_given)
        if "masses" in names:
            free = key == "compliance" and isinstance(given[key], Mapping) and given[key].get("masses") == "free"
            needed = not free and (key != "backlash" or options.get("side") == "load")
            if needed and not loaded and None in links:
                masses = masses or tuple(links[None]())
            expected = NO_MASSES if key == "compliance" else f"the mass and com of each link ({GUESS})"
            expect(masses or not needed, here, "no masses", expected)
            if free and "payload" in given[key]:
                raise InputError(here, "a payload with free masses", "masses: urdf, or by link")
            options["masses"] = None if free else masses if needed else ()
        if "gravity" in names and gravity is not None:
            options.setdefault("gravity", gravity)
        with within(here):
            effects.append(of(**options))
    return effects


def _masses(given: Mapping[str, Any], place: str, links: Mapping[Any, Any], n_joints: int) -> tuple[Mass, ...]:
    """The masses of the entry of compliance, its payload among them."""
    wanted, found = given.get("masses", "urdf" if None in links else None), list[Mass]()
    if wanted == "urdf":
        expect(None in links, f"{place}: masses", "found 'urdf', but there is none", NO_MASSES)
        found += links[None]()
    elif isinstance(wanted, Mapping):
        for link, value in wanted.items():
            here = f"{place}: masses: {link}"
            expect(str(link) in links, here, f"no link {shown(link)}", f"one of {', '.join(filter(None, links))}")
            mass = validate(_Mass, value, here)
            found.append(links[str(link)](mass.mass, mass.com))
    elif wanted not in (None, "free"):
        hint = did_you_mean(wanted, ("urdf", "free"))
        raise InputError(f"{place}: masses", f"found {shown(wanted)}", "urdf, free, or masses by link", hint)
    if "payload" in given:
        payload = validate(_Payload, given["payload"], f"{place}: payload")
        found.append(Mass(n_joints, payload.mass, payload.com, payload.column))
    return tuple(found)


def with_coefficients(robot: Robot, given: Mapping[str, Any], place: str) -> Robot:
    """The robot with nominal coefficients of its effects: a figure each, and a list for an error curve.

    Raises:
        InputError: A coefficient that there is not, or another number of them.
    """
    values = robot.nominal
    for name, value in given.items():
        each = value if isinstance(value, Sequence) and not isinstance(value, str) else [value]
        names = [p.name for p in robot.parameters if p.name.startswith(f"{name}[")] or [name]
        figures = as_floats(f"{place}: {name}", each, "(n)")
        if len(figures) != len(names):
            raise InputError(f"{place}: {name}", f"{len(figures)} figures", str(len(names)) if names[1:] else "one")
        with within(place):
            values[[robot.index(one) for one in names]] = figures
    return robot.with_values(values)


def effects_mapping(robot: Robot) -> dict[str, Any]:
    """What a robot file says of the effects of a robot."""
    keys, out, values = {of: key for key, of in EFFECTS.items()}, dict[str, Any](), dict[str, Any]()
    for effect in robot.effects:
        options = {f.name: getattr(effect, f.name) for f in fields(effect)}  # type: ignore[arg-type]
        if "masses" in options:
            masses = options["masses"]
            options["masses"] = "free" if masses is None else _mapping_of([m for m in masses if not m.column])
            for m in (m for m in masses or () if m.column):
                options["payload"] = {"mass": m.mass, "com": list(m.com), "column": m.column}
        expect(type(effect) in keys, robot.name, f"an effect {type(effect).__name__}", f"of {', '.join(EFFECTS)}")
        out[keys[type(effect)]] = options
    curves = defaultdict[str, list[float]](list)
    for p in robot.parameters:
        if p.kind == "curve":
            curves[p.name.partition("[")[0]].append(p.nominal)
        elif p.kind in EFFECT_KINDS and p.nominal:
            values[p.name] = p.nominal
    values |= {name: each for name, each in curves.items() if any(each)}
    return out | ({"values": values} if values else {}) | ({"select": True} if robot.select_effects else {})


def _mapping_of(masses: Sequence[Mass]) -> dict[int | str, Any]:
    """Masses by link; those on one link together."""
    out, links = dict[int | str, Any](), [one.hinges[-1].link if one.hinges else one.link for one in masses]
    for link in dict.fromkeys(links):
        each = [one for one, its in zip(masses, links, strict=True) if its == link]
        total = sum(one.mass for one in each)
        com = np.array([one.mass for one in each]) @ np.array([one.com for one in each]) / total
        out[link] = {"mass": total, "com": com.tolist()}
    return out
