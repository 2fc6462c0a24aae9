"""What a cell of a header says: its name and its unit, and the role of the column by both.

An explicit unit decides the role first, then the words of the name.

Names and units of a header's cells: `x[m]`, `x (m)`, `x(m)`, `x/m`, `v/(m/s)`, `x in m`, `x_mm` and `angleDeg`.

A slash stands before a known unit (ISO 80000-1: a quantity over its unit), unless another column has the same name
before a slash: `arm/A` beside `arm/B` is a path. A unit of time stands behind the name of a time alone, unlike `x/s`.

A unit that ends a name without brackets is one of `KINDS`. It is none where it is an index or a word:

* a unit of time behind another name than that of a time: `x_min`;
* a length behind the name of an angle: theta_m is the angle of a motor;
* a letter or a word (`AMBIGUOUS`) behind a name that says another role than the unit, as in `tau_m` and `x_A`, or
  beside a column of the same name with an index that is no unit: `joint_A` beside `joint_B`, `F_N` beside `F_T`.

A whole number in square brackets is part of the name, as in `position[0]`, except for the unit 1 of `x[1]`; beside
such a name, `x[1]` is a name, too.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple
from unicodedata import combining, normalize

ANGLES = re.compile(r"[mµμ]?rad|radians?|deg|°|degrees?|[Gg]rad|degrés|grados|gradi|gon|revs?|turns?|arcmin|arcsec")
# Kinds of units, in the order of trial. With other units, such as counts or 1, and shares, the name decides the role.
KINDS = {
    "position": re.compile(rf"{ANGLES.pattern}|[kcdmµμunp]?m|met(er|re)s?|in|inch(es)?|ft|feet|mils?|thou|px|pixels?"),
    "time": re.compile(r"s|ms|us|µs|μs|ns|min|h|secs?|seconds?|msec|usec"),
    "effort": re.compile(
        r"[kmMµμ]?N([ *·.⋅-]?[cm]?m)?|kgf|lbs?|(lbf?|ozf?)([ *·.⋅-]?(ft|in))?|(ft|in)[ *·.⋅-]?(lbf?|ozf?)"
    ),
    "electric": re.compile(r"[kmµμ]?[AV]|Vdc|VDC|volts?|amps?|%|percent|pct"),
    "field": re.compile(r"[mµμun]?(Wb|T)|V[ *·⋅]s|[mµμun]?H|[mµμunp]F"),
    "pressure": re.compile(r"[kMh]?Pa|m?bar|psi|s?lpm|gpm|(m?[lL]|m3|m³)/ ?(s|min|h)"),
    "acceleration": re.compile(r".+/ ?(s|ms|min)(\^2|²|2|\*\*2)|.+[ ·*]s(\^-2|⁻²)|g|g0"),
    "rate": re.compile(r".+/ ?(s|ms|min|h|sec)|(.+[ ·*])?(s|min)(\^-1|⁻¹)|rpm|RPM|dps|mps|kph|mph"),
    # A share of a nominal value, as of electric machines.
    "share": re.compile(r"pu|PU|p\.u\.?"),
    "other": re.compile(r"°? ?[CF]|℃|degC|K|[kMGm]?(Hz|W|J|Ω|g)|[Oo]hms?|kg|dB|VA|m?[AW]h|bool"),
}
NUMBERED = r"(_?\d+|_.*)?"
# Words of a time that name its unit, as Arduino's millis() and micros() do.
UNITS_OF_TIME = {"millis": "ms", "milliseconds": "ms", "ms": "ms"} | dict.fromkeys(
    ("micros", "microseconds", "us", "µs", "μs"), "us"
)
# Names that have a role whatever their words, unless the unit is of another kind.
ROLES = {
    "time": re.compile(
        r"t|times?|timestamps?|date|datetime|secs?|seconds|elapsed|zeit|zeitstempel|uhrzeit|temps|heure|tiempo|hora|tempo|tijd|tid"
        r"|czas|čas|aika|(.+[._/])?stamp|millis|micros|milliseconds|microseconds|ms|us|µs|μs"
    ),
    "trajectory": re.compile(
        r"(trajectory|trial|run|recording|experiment|episode|versuch|lauf|messreihe|essai|ensayo|prueba|prova)"
        r"([ _-]?(id|nr|no|num|number|index|n°|#)\.?)?"
    ),
    "action": re.compile(r"s"),
    "momentum": re.compile(r"p|p_.*"),
    # Left aside, as are rates: logged velocities are usually filtered, and counters of rows are no motion.
    "counter": re.compile(r"index|row|sample|(.+[._/])?seq|(sub[ _]?)?frame#?|step|dt|unnamed: \d+"),
    "input": re.compile(rf"u{NUMBERED}|F|f(\d+|[xyz]|_.*)|i_?[qd]"),
}
SYMBOL = r"(?:[qxyzr]|theta|phi|psi|alpha|beta|gamma|th|θ|φ|ϕ|ψ|α|β|pos|position|angle|joint|roll|pitch|yaw)"
RATE = re.compile(
    rf"v\d*|[va]_[xyz]|(.+_)?[vaw][xyz]|d?d?{SYMBOL}_?\d*_?(d?dot|vel|velocity|speed|rate|acc)(_?\d+)?|{SYMBOL}_?d?d_?\d+|{SYMBOL}dd"
    rf"|dd?_?{SYMBOL}{NUMBERED}|d\d?.+?_?/?dt(\^?2)?|(vel|acc|gyro|gf)[xyz]\d*"
)
# Letters of velocities and accelerations, unless the unit is that of a position.
LETTERS = re.compile(r"[vaw]_?([xyz]|\d*)")
# Symbols of voltages, currents, forces and control signals, which may be commanded: V_cmd. v_cmd is a speed.
EFFORT_SYMBOL = re.compile(r"[VUIFMui][ _-].+")
# A desired value, or a derivative: q_d.
DESIRED = re.compile(rf"{SYMBOL}\d*_?d(_\d+)?")
# Usual names of coordinates.
KNOWN = re.compile(rf"{SYMBOL}\d*(_.*)?|[qxyz]\(.*|.+_[xyz]\d*")
# The last part of a German compound decides, Motorstrom, Winkelgeschwindigkeit, or a first part for an excitation or a
# goal: Erregerwinkel, Zielwinkel.
COMPOUND = re.compile(
    "^(?:erreger|ziel|anregung(?=s))(?=.)|(?<=.)(?:winkel|kraft|moment|strom|spannung|drehzahl|geschwindigkeit|beschleunigung"
    "|fehler|temperatur|zeit|erregung|anregung)$"
)
# A column that was filtered from another: theta_filt beside theta, x_smoothed beside x_raw.
COPY = re.compile(
    r"(?:filt(?:ered)?|smooth(?:ed)?)[ _-]?(?P<before>.+)|(?P<behind>.+?)(?:[ _-]lp|[ _-]?"
    r"(?:filt(?:ered)?|smooth(?:ed)?|lowpass|gefiltert|geglättet|filtrée?|filtrad[oa]|filtrat[oa]))"
)
# Words without accents: ángulo is here as angulo. Kinds of words that need a reason:
# side: quantities that are measured beside a motion. attribute: of a position (motor_angle), or else of an input.
# reading: sensors of positions, even in volts. excitation: places that move the mechanism from outside; support:
# places that may do so.
_WORDS = {
    "goal": "goal target setpoint setpoints sp desired des reference ref command commands commanded cmd demand "
            "demanded wanted vorgabe fuhrungsgrosse fuehrungsgroesse ziel gewunscht consigne commande cible desire "
            "desiree consigna referencia objetivo deseado deseada riferimento comando obiettivo desiderato desiderata "
            "desejado desejada gewenst gewenste zadany zadana",
    "side": "error err std sd stderr variance var covariance cov uncertainty residual quality confidence likelihood "
            "temperature temp temperatur temperatura battery batt supply humidity status statusword statuswort valid "
            "checksum crc power leistung puissance potencia potenza fehler regelabweichung erreur errore reward done",
    "rate": "velocity velocities vel speed rate acceleration acc accel omega gyro jerk dot ddot rpm "
            "geschwindigkeit drehzahl beschleunigung vitesse velocidad aceleracion velocita accelerazione",
    "position": "position positions pos angle angles displacement height elongation location coordinate "
                "winkel weg lage auslenkung verschiebung deplacement angulo posicion desplazamiento angolo posizione "
                "spostamento",
    "angle": "theta phi psi angle alpha beta gamma roll pitch yaw winkel angulo angolo θ φ ϕ ψ α β",
    "effort": "force forces torque torques tau effort efforts voltage volt pwm duty throttle kraft drehmoment moment "
              "strom spannung couple courant tension fuerza corriente voltaje coppia corrente forza tensione grf "
              "thrust schub empuje poussee spinta gas gaz",
    "torque": "torque torques tau drehmoment moment couple coppia",
    "attribute": "motor current input inputs control controls ctrl action actions stellgrosse stellgroesse "
                 "eingang eingangssignal entree entrada ingresso",
    "reading": "pot potentiometer lvdt encoder laser",
    "excitation": "road ground floor shaker exciter excitation erreger erregung anregung excitateur excitador "
                  "excitacion eccitazione disturbance seismic quake earthquake erdbeben seisme terremoto boden sol "
                  "suelo suolo",
    "support": "base pivot support platform fusspunkt fundament",
}  # fmt: skip
WORDS = {kind: frozenset(words.split()) for kind, words in _WORDS.items()}
# Words that call a column an input; so does `in` beside a column `out`, where it is no inch and no preposition.
GIVEN = frozenset(("input", "inputs", "control", "controls", "eingang", "entree", "entrada", "ingresso"))
ACCELERATION = frozenset(("acceleration", "acc", "accel", "beschleunigung", "aceleracion", "accelerazione"))
# A floor shakes what stands on it, unless it is a storey.
STOREY = "floor"
BY_NAME, BY_UNIT = "by its name alone", "by its unit alone"
MOVED = "it may be moved from outside"
READING = "it may be the reading of a position"


class Guess(NamedTuple):
    """The role of a column, a key of `ROLES`, "rate", "dropped" or "q", and the doubt about the role, or ""."""

    role: str
    doubt: str = ""


def role_of(name: str, unit: str, others: Collection[str] = (), shaken: bool = False) -> Guess:
    """The role of a column by its own name and unit.

    `others` are the names of all columns: dx is the rate of x. `shaken` says whether what shakes a structure is among
    them (`is_shaken`): its floors are storeys then.
    """
    name, others = plainly(name), [plainly(other) for other in others]
    guess = _own_role(name, unit, others, shaken)
    copy = COPY.fullmatch(name.casefold()) if guess.role == "q" else None
    base = copy and (copy["before"] or copy["behind"])
    # The other column, or its raw values.
    if base and {base, f"{base}_raw", f"raw_{base}"}.intersection(other.casefold() for other in others):
        return Guess("dropped", "it may be more than a filtered copy of another column")
    return guess


def _own_role(name: str, unit: str, others: Collection[str], shaken: bool) -> Guess:
    """The role of a column that is no filtered copy of another."""
    kind = kind_of(unit)
    # "Time" means time, but a single "V" may be a volume.
    key = name.casefold() if len(name) > 1 else name
    words = words_of(name)
    numbered = re.search(rf"{STOREY}[ _-]?\d|\d[ _-]?{STOREY}", key)
    if STOREY in words and (shaken or numbered):
        guess = _by_kind(key, unit, words - {STOREY}, others)
        return Guess("q", MOVED) if guess == Guess("q") and not numbered else guess
    if whole := _whole(key, kind):
        # An input in the unit of a position that only its letter u names.
        letter = kind == "position" and re.fullmatch(r"u_?([xyz]|\d*)", key)
        return Guess(whole, "it has the unit of a position" if letter else "")
    if words & WORDS["side"]:
        return Guess("dropped")
    if is_goal(words):
        return Guess("input")
    if DESIRED.fullmatch(key) and kind in ("", "position"):
        role = "input" if kind else "dropped"
        return Guess(role, "it may be a desired value or a derivative")
    return _by_kind(key, unit, words, others)


def _by_kind(key: str, unit: str, words: frozenset[str], others: Collection[str]) -> Guess:
    """The role of a column that is no set point, by the kind of its unit."""
    kind = kind_of(unit)
    if kind in ("", "share"):
        guess = _by_words(key, words, others)
        # A share acts, as percents do, unless its name is that of a position or a rate; Q is a reactive power.
        is_place = not kind or KNOWN.fullmatch(key) or words & WORDS["position"]
        return guess if guess.role != "q" or is_place else Guess("input", BY_UNIT)
    return _in_place(key, unit, words, others) if kind == "position" else _by_unit(key, kind, words)


def is_shaken(heads: Iterable[tuple[str, str]]) -> bool:
    """Whether a column of these names and units has the motion of a ground, a shaker or a base, beside any floors."""
    return any(
        words & (WORDS["excitation"] | WORDS["support"]) - {STOREY} and role_of(name, unit).role == "input"
        for name, unit in heads if not is_effort(words := words_of(name), unit)
    )  # fmt: skip


def kind_of(unit: str) -> str:
    """The kind of a unit, a key of `KINDS`; "" for no unit, or a unit that many quantities have."""
    return next((kind for kind, pattern in KINDS.items() if pattern.fullmatch(unit)), "")


def is_of_others(unit: str, units: Collection[str]) -> bool:
    """Whether an acceleration in this unit is none of coordinates in `units`: these are all of the other kind.

    The two kinds are angles and lengths.
    """
    angular = bool(ANGLES.fullmatch(re.split(r"[/ ·*]", unit)[0]))
    known = all(unit not in ("", "1") for unit in units)
    return kind_of(unit) == "acceleration" and known and angular not in {bool(ANGLES.fullmatch(x)) for x in units}


def is_rate_of_others(name: str, coordinates: Collection[str]) -> bool:
    """Whether the name of a rate has words of its own, and none of these coordinates': `hoop speed` beside `bead`."""
    own = words_of(name) - WORDS["rate"]
    known = frozenset(word for other in coordinates for word in words_of(other))
    return bool(own) and not own & known and not RATE.fullmatch(plainly(name).casefold())


def is_angular(name: str) -> bool:
    """Whether a name is usual for angles."""
    return bool(words_of(name) & WORDS["angle"])


def is_torque(name: str) -> bool:
    """Whether a name is usual for torques, which act on angles."""
    return bool(words_of(name) & WORDS["torque"])


def is_time(name: str, unit: str) -> bool:
    """Whether a column has a usual name or a unit of a time."""
    return kind_of(unit) == "time" or bool(ROLES["time"].fullmatch(name.casefold() if len(name) > 1 else name))


def is_goal(words: frozenset[str]) -> bool:
    """Whether the words of a name are those of a set point."""
    several = "set" in words and len(words) > 1
    return several or bool(words & WORDS["goal"]) or any(word.startswith("soll") for word in words)


def is_effort(words: frozenset[str], unit: str) -> bool:
    """Whether an input with these words in its name is a force, a voltage or a current."""
    return kind_of(unit) in ("effort", "electric") or bool(words & WORDS["effort"])


def is_set_point(name: str, unit: str) -> bool:
    """Whether an input is the set point of a controller, and not a force, voltage or current that is commanded."""
    words = words_of(name)
    return is_goal(words) and not is_effort(words, unit) and not (kind_of(unit) == "" and EFFORT_SYMBOL.fullmatch(name))


def is_recorded_effort(name: str, unit: str) -> bool:
    """Whether an input is a force, a voltage or a current that acts, and not one that is commanded."""
    words = words_of(name)
    return not is_goal(words) and is_effort(words, unit)


def is_timed(words: frozenset[str]) -> bool:
    """Whether a word of a name is that of a time: `elapsed_time`, but neither a letter nor `us_distance`."""
    return any(len(word) > 2 and ROLES["time"].fullmatch(word) for word in words)


def unit_of_time(name: str) -> str:
    """The unit that the name of a time says, `millis` and `elapsed_us`; "" if the name says none."""
    return next((unit for word, unit in UNITS_OF_TIME.items() if word in words_of(name)), "")


def is_usual(name: str, unit: str) -> bool:
    """Whether the unit or the name is usual for coordinates."""
    usual = KNOWN.fullmatch(plainly(name).casefold()) or words_of(name) & WORDS["position"]
    return kind_of(unit) == "position" or bool(usual)


def may_be_place(name: str, unit: str) -> bool:
    """Whether a column is none of an acceleration, a rate, a force and a share of a nominal value."""
    kind = kind_of(unit)
    by_name = kind or not words_of(name) & WORDS["rate"]
    return bool(by_name) and kind not in ("acceleration", "rate", "effort", "share")


def plainly(name: str) -> str:
    """A name with its numbers out of their brackets: q[0] has the role of q0."""
    return re.sub(r"\[(\d+)\]", r"\1", name)


def words_of(name: str) -> frozenset[str]:
    """The words of a name, in lower case and without accents: `ActCurrent`, `goal_position` and `x vel` have two each.

    The part of a German compound that decides is a further word.
    """
    parts = re.findall(r"[^\W\d_]+", name)
    found = [word for part in parts for word in re.findall(r"[A-ZÄÖÜ]?[^A-ZÄÖÜ]+|[A-ZÄÖÜ]+(?![^A-ZÄÖÜ])", part)]
    words = frozenset(map(_folded, found))
    return words | {part for word in words for part in COMPOUND.findall(word)}


def _whole(key: str, kind: str) -> str:
    """The role of a name as a whole, unless its unit is of another kind; "" for no role."""
    role = next((role for role, pattern in ROLES.items() if pattern.fullmatch(key)), "")
    if key in UNITS_OF_TIME:
        return role if kind in ("", "time") else ""
    if role in ("action", "momentum"):
        return "" if kind in ("position", "pressure", "share", "other") else role
    if role == "trajectory":
        return "" if kind else role
    meant = kind in ("", "effort", "electric", "share") or (kind == "position" and key[0] == "u")
    return "" if role == "input" and not meant else role


def _in_place(key: str, unit: str, words: frozenset[str], others: Collection[str]) -> Guess:
    """The role of a column in the unit of a position: a coordinate, unless the name is usual for an excitation."""
    # A tendon input is an input, and so is the input x beside x; an input shaft is a shaft.
    if given := _given(key, others):
        rest = [word for word in _in_order(key) if word not in given]
        same = any(_in_order(other) == rest for other in others)
        if same or not rest or _last(key) in given:
            return Guess("input", "it has the unit of a position")
    if _is_rate(key, words, others, "position"):
        return Guess("rate", "it has the unit of a position")
    if words & WORDS["excitation"]:
        return Guess("input", BY_NAME)
    moved = words & WORDS["support"] and not ANGLES.fullmatch(unit)
    alone = words <= WORDS["support"] | WORDS["position"]
    if moved:
        return Guess("input", BY_NAME) if alone else Guess("q", MOVED)
    return Guess("q", "its name may be that of an input" if given else "")


def _by_unit(key: str, kind: str, words: frozenset[str]) -> Guess:
    """The role of a column with a unit that no position has."""
    if kind == "acceleration" and words & (WORDS["excitation"] | WORDS["support"]):
        return Guess("input", BY_NAME)
    # The width of a pulse commands a servo.
    if kind == "time" and words & {*WORDS["effort"], "pulse"} and not is_timed(words):
        return Guess("input")
    if kind in ("effort", "electric"):
        read = words & WORDS["reading"] and not words & (WORDS["effort"] | WORDS["attribute"])
        read = read or re.fullmatch(SYMBOL + r"_?\d*", key)
        return Guess("dropped", READING) if kind == "electric" and read else Guess("input")
    if kind in ("pressure", "field"):
        return Guess("dropped", READING if kind == "field" else "it may be an input")
    return Guess("rate" if kind in ("rate", "acceleration") else "dropped")


def _by_words(key: str, words: frozenset[str], others: Collection[str]) -> Guess:
    """The role of a column whose unit does not decide."""
    shaken = words & ACCELERATION and words & WORDS["support"]
    if shaken or words & WORDS["excitation"]:
        return Guess("input", "" if words & WORDS["effort"] else BY_NAME)
    if is_timed(words):
        return Guess("dropped")
    if _is_rate(key, words, others, ""):
        return Guess("rate")
    given = _given(key, others)
    attribute = words & (WORDS["attribute"] | given)
    if words & (WORDS["position"] | WORDS["reading"]) and not words & WORDS["effort"]:
        return Guess("q", "its name may be that of an input" if given else "")
    if attribute and re.fullmatch(SYMBOL, _last(key)):
        return Guess("q", "its name may be that of an input")
    return Guess("input" if attribute or words & WORDS["effort"] else "q", BY_NAME if attribute == {"in"} else "")


def _in_order(name: str) -> list[str]:
    """The parts of a name in their order, in lower case, without numbers and accents."""
    return re.findall(r"[^\W\d_]+", _folded(name))


def _folded(text: str) -> str:
    """A text in lower case and without accents."""
    return "".join(x for x in normalize("NFD", text.casefold()) if not combining(x))


def _last(key: str) -> str:
    """The last word of a name, without a number behind it; "" for a name without letters."""
    return next(reversed(_in_order(key)), "")


def _given(key: str, others: Collection[str]) -> frozenset[str]:
    """The words of a name that call it an input; `in` does beside a column `out`."""
    words = frozenset(_in_order(key))
    beside = any({"out", "output"}.intersection(_in_order(other)) for other in others)
    return words & (GIVEN | {"in"} if beside else GIVEN)


def _is_rate(key: str, words: frozenset[str], others: Collection[str], kind: str) -> bool:
    """Whether a name is usual for a rate; vx in the unit of a position, or dx without a column x, is no rate."""
    if kind == "position":
        of = re.fullmatch(r"dd?_?(.+)", key)
        if LETTERS.fullmatch(key) or (of and of[1] not in {name.casefold() for name in others}):
            return False
    return bool(RATE.fullmatch(key) or words & WORDS["rate"])


CELL = re.compile(r"((?:[^\[\]]|\[\d+\])+?)(?:\s*\[([^\[\]]*)\]|\s+\(([^()]*)\))?\s*")
# A name that ends with a whole number in brackets.
ELEMENT = re.compile(r"(.+)\[(\d+)\]\s*")
# A unit without a space before the bracket, if the bracket holds a known unit: x(1) is a name.
TIGHT = re.compile(r"([^()]+)\(([^()]+)\)")
# A quantity over its unit: t/s, phi / °, v/(m/s).
SLASH = re.compile(r"([^/\[\]()]+?)\s*/\s*(?:[\[(](.+)[\])]|([^\[\]()]+?))\s*")
# A quantity in its unit: Weg in mm, angle en °.
WITHIN = re.compile(r"(.+?)\s+(?:in|en)\s+(\S+)\s*")
# Units that are read in any case, and as the last word of a name in camel case.
CASELESS = re.compile(r"(?:deg|rad)(?:/s2?)?|mm|rpm|s|ms|us|ns|min", re.I)
# A name, and a unit of two parts or one at its end. The momentum of x_deg is p_x_deg.
ENDS = (
    re.compile(r"(?!p_)(.+)_(?!per_)([^\W_]+)_(?:per_)?(s2?|min|h|m)"),
    re.compile(r"(?!p_)(.+)_([^_]+)"),
    re.compile(rf"(?!p_)(.*[a-z\d])(?=[A-Z])((?i:{CASELESS.pattern}))"),
)
# What a unit of two parts begins with, beside lengths and angles: turns in French and German, litres, newtons.
PARTS = re.compile(r"tr|U|m?[lL]|[km]?N")
# Units that are letters of bodies or words as well.
AMBIGUOUS = re.compile(r"[mNAV]|cm|km|psi|bar|grad")
INDEX = re.compile(r"[^\W_]|\d+")


def name_and_unit(cell: str) -> tuple[str, str] | None:
    """Name and unit of a header's cell, "" if the cell alone shows no unit; None for any other text."""
    match = CELL.fullmatch(cell)
    if not match or not cell.isprintable():
        return None
    if (element := ELEMENT.fullmatch(cell)) and element[2] != "1":
        return cell.strip(), ""
    for ends in filter(None, (SLASH.fullmatch(cell), WITHIN.fullmatch(cell))):
        name, unit = filter(None, ends.groups())
        if kind_of(unit) and _is_timed(name) == (kind_of(unit) == "time"):
            return name, unit
    if match[2] is not None or match[3] is not None:
        return match[1], (match[2] or match[3] or "").strip()
    if (tight := TIGHT.fullmatch(match[1])) and kind_of(tight[2]):
        return tight[1], tight[2]
    name, unit = _split(match[1])
    return (match[1], "") if AMBIGUOUS.fullmatch(unit) else (name, unit)


def heads_of(cells: Sequence[str], known: Collection[str] = ()) -> list[tuple[str, str] | None]:
    """Name and unit of each cell of a table; None as in `name_and_unit`.

    Columns keep the names that they have in another table, whose names are `known`.
    """
    elements = [ELEMENT.fullmatch(cell) for cell in cells]
    numbered = {element[1] for element in elements if element and element[2] != "1"}
    # position[0][1] is position[0] in the unit 1.
    whole = [e and numbered and (e[1] in numbered or "[" not in e[1]) for e in elements]
    heads = [(cell.strip(), "") if own else name_and_unit(cell) for cell, own in zip(cells, whole, strict=True)]
    names = [head[0] for head in heads if head]
    heads = [head and _in_table(cell, head, names, known) for cell, head in zip(cells, heads, strict=True)]
    count = Counter(head[0] for head in heads if head)
    return [_whole_cell(cell, head[1]) if head and count[head[0]] > 1 else head
            for cell, head in zip(cells, heads, strict=True)]  # fmt: skip


def _in_table(cell: str, head: tuple[str, str], names: Sequence[str], known: Collection[str]) -> tuple[str, str]:
    """Name and unit of a cell beside columns of these names."""
    path = SLASH.fullmatch(cell) and any(name.startswith(f"{head[0]}/") for name in names)
    if cell in known or path or f"p_{cell}" in names:
        return cell, ""
    name, unit = _split(head[0])
    return (name, unit) if unit and not head[1] and (name in known or _is_unit(name, unit, names)) else head


def _whole_cell(cell: str, unit: str) -> tuple[str, str]:
    """Name and unit of a cell whose name repeats: the brackets of `x (raw)` hold no unit, and `x_deg` is a name."""
    return (cell.strip(), "" if cell.endswith(")") else unit) if not cell.endswith("]") else (cell.split("[")[0], unit)


def _split(text: str) -> tuple[str, str]:
    """Name and unit of a name that ends with what may be its unit; the whole name and "" if it does not."""
    for match in filter(None, (end.fullmatch(text) for end in ENDS)):
        name, *parts = match.groups()
        unit = (" " if parts[-1] == "m" else "/").join(parts)
        unit = unit.lower() if CASELESS.fullmatch(unit) else unit
        if _may_have(name, unit):
            return name, unit
    return text, ""


def _is_timed(name: str) -> bool:
    """Whether a name is that of a time."""
    return is_time(name, "") or is_timed(words_of(name))


def _may_have(name: str, unit: str) -> bool:
    """Whether a column of this name may be in this unit: see the head of this module."""
    kind, part = kind_of(unit), kind_of(base := re.split("[/ ]", unit)[0])
    if not kind or (base != unit and part != "position" and not PARTS.fullmatch(base)):
        return False
    timed = _is_timed(name)
    length = part == "position" and not ANGLES.fullmatch(base)
    letter = len(unit) == 1 and unit.isalpha() and not AMBIGUOUS.fullmatch(unit)
    # Behind the name of a rate g is that of gravity, as in ax_g; q_g is a name.
    letter = letter and not (unit == "g" and role_of(name, "").role == "rate")
    # x_in is the input beside x_out, x_lb the lower bound, and left_feet are feet.
    word = base in ("in", "feet", "lb")
    if timed != (kind == "time") or (length and is_angular(name)) or (letter and not timed) or word:
        return False
    return role_of(name, unit).role not in ("action", "momentum", "counter")


def _is_unit(name: str, unit: str, names: Sequence[str]) -> bool:
    """Whether an ambiguous end of a name is its unit, among columns of these names."""
    others = [other.removeprefix(f"{name}_") for other in names if other.startswith(f"{name}_")]
    if any(INDEX.fullmatch(other) and not _may_have(name, other) for other in others):
        return False
    symbol = re.fullmatch(rf"{SYMBOL}\d*", name.rsplit("_")[-1].casefold()) and not words_of(name) & WORDS["position"]
    told = role_of(name, "", names)
    if told.role != "q" or symbol:
        return told == role_of(name, unit, names)
    # A coordinate of one letter has a usual one: i_m may be the current of a motor.
    return len(name) > 1 or kind_of(unit) != "position"
