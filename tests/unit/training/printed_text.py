"""The right side of a printed line as Python text: names, numbers with deviations, powers, functions and products."""

import re

POWERS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
NUMBER = re.compile(r"(\d+(?:\.\d+)?)(?:\((?:±)?[\d.e+-]+\))?(e[-+]?\d+)?")
POWER = re.compile(r"[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+")
FUNCTIONS = {"sin": "np.sin", "cos": "np.cos", "tanh": "np.tanh", "exp": "np.exp", "sgn": "sgn", "√": "np.sqrt"}
SIGNS = {"+": "+", "−": "-"}


class Reader:
    """Python text of a sum of products, by recursive descent."""

    def __init__(self, text, symbols):
        self.text, self.at = text, 0
        self.words = sorted((FUNCTIONS | symbols).items(), key=lambda pair: -len(pair[0]))

    def skip(self):
        while self.text[self.at : self.at + 1] == " ":
            self.at += 1

    def take(self, mark):
        self.skip()
        found = self.text.startswith(mark, self.at)
        self.at += len(mark) * found
        return found

    def sum(self, closed=""):
        return "".join(self.terms(closed))

    def terms(self, closed=""):
        found, sign = [], next((s for mark, s in SIGNS.items() if self.take(mark)), "")
        while sign is not None:
            found.append(sign + self.product(closed))
            sign = next((s for mark, s in SIGNS.items() if self.take(mark)), None)
        return found

    def product(self, closed):
        found = []
        while True:
            self.skip()
            rest = self.text[self.at : self.at + 1]
            if not rest or rest in "+−)" or (rest == "|" and closed == "|" and found):
                return "*".join(found)
            if self.take("/"):
                found[-1] = f"({found[-1]})/({self.factor()})"
            else:
                found.append(self.factor())

    def factor(self):
        self.skip()
        base = self.base()
        if match := POWER.match(self.text, self.at):
            self.at = match.end()
            return f"({base})**({float(match[0].translate(POWERS))})"
        return base

    def base(self):
        for name, code in self.words:
            if not self.text.startswith(name, self.at):
                continue
            self.at += len(name)
            if name not in FUNCTIONS:
                return code
            self.skip()
            return f"{code}({self.inside() if self.text[self.at] == '(' else self.base()})"
        if match := NUMBER.match(self.text, self.at):
            self.at = match.end()
            return match[1] + (match[2] or "")
        if self.take("|"):
            inside = self.sum("|")
            assert self.take("|"), self.text
            return f"abs({inside})"
        return f"({self.inside()})"

    def inside(self):
        assert self.take("("), f"{self.text!r} from {self.text[self.at :]!r}"
        found = self.sum()
        assert self.take(")"), self.text
        return found
