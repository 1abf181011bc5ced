"""The words that the recogniser tells apart, and the sentences that it is taught and asked."""

import numpy as np

# Every word of the operator's grammar that is spoken, and of its numbers.
WORDS = (
    *("robot", "open", "close", "half", "way", "the", "valve", "by", "degrees"),
    *("confirm", "cancel", "status", "reset", "stop", "please", "now", "and"),
    *("one", "two", "three", "five", "ten", "fifteen", "twenty", "thirty", "forty", "fifty"),
    *("sixty", "seventy", "eighty", "ninety", "hundred"),
)
BLANK, OTHER = 0, 1  # classes: nothing new is said; another word. Word k of WORDS is class 2 + k
CLASSES = 2 + len(WORDS)
INDEX = {word: 2 + k for k, word in enumerate(WORDS)}
# Among other people's words these are as common as short: there they are taught as OTHER.
WEAK = ("way", "the", "by", "please", "now", "and", "one", "two", "three")

# Words that sound like ours, or stand where ours stand.
CONFUSABLE = tuple(
    "top shop step stock start stuff store stopped stopping spot drop hop staff stoop steep "
    "often oven opera opener opening over hope broken spoken token "
    "clothes clone clue clothing closet clove cloud glow those chose "
    "robert rabbit rowboat rob rope robin orbit robbing rubber "
    "conform comfort confer affirm convert concern farm firm content confused "
    "statue stages state static stations stated "
    "council canceled pencil handle candle counsel recess receipt resent preset reject "
    "have has calf laugh hat halt hearth value valley veil van volume "
    "decrease disease agrees degree decreed night mine line fly buy "
    "nineteen eighteen seventeen sixteen fourteen thirteen twelve eleven ninth tenth "
    "left right window door water table engine shutter hatch gate lid lamp pump motor".split()
)
COMMON = tuple(
    "a about after again all also an any are as at back be because been before but came can come could day did do down "
    "each even few find first for from get give go good great had he her here him his house how i if in into is it its "
    "just know last like little long look made make many may me men more most much must my never new no not of off old "
    "on only or other our out over own people place put said same see she should small so some still such take tell "
    "than that their them then there these they thing think this time to too under up us use very want was water way "
    "we well went were what when where which who will with work world would year you your morning radio message "
    "channel report weather ship road green yellow river mountain paper kitchen garden music number letter answer "
    "question picture country school family doctor winter summer coffee bread street machine engine metal".split()
)
NUMBERS = (10, 15, 20, 30, 45, 60, 75, 90, 120, 135, 150, 180, 270, 360)
_TENS = ("", "ten", "twenty", "thirty", "forty", "fifty", "sixty", "seventy", "eighty", "ninety")


def spelt(number: int) -> str:
    """A multiple of five below 1000 in words."""
    hundreds, rest = divmod(number, 100)
    small = ["fifteen"] if rest == 15 else [_TENS[rest // 10], "five" if rest % 10 else ""]
    units = ("", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
    return " ".join(word for word in ([units[hundreds], "hundred"] if hundreds else []) + small if word)


def labels(text: str) -> list[int]:
    """The classes of a sentence's words, runs of other words as one OTHER; weak words beside one belong to it."""
    words = [word for word in "".join(c if c.isalpha() else " " for c in text.lower()).split()]
    foreign = [word not in INDEX for word in words]
    while True:
        grown = [foreign[k] or (word in WEAK and any(foreign[max(k - 1, 0) : k + 2])) for k, word in enumerate(words)]
        if grown == foreign:
            break
        foreign = grown
    out: list[int] = []
    for word, other in zip(words, foreign):
        if not other:
            out.append(INDEX[word])
        elif out[-1:] != [OTHER]:
            out.append(OTHER)
    return out


def command(rng: np.random.Generator) -> str:
    """A sentence of the grammar."""

    def pick(*choices: str) -> str:
        return choices[rng.integers(len(choices))]

    number = spelt(int(rng.choice(NUMBERS)))
    if rng.random() < 0.3:
        number = number.replace("hundred ", "hundred and ")
    amount = pick("half", "half", "half way", *[f"by {number} degrees"] * 6)
    move = f"{pick('open', 'close')}{pick('', ' the valve', ' the valve')}{pick('', ' ' + amount, ' ' + amount)}"
    rest = pick(*[move] * 8, *[amount] * 2, *["confirm"] * 3, "cancel", "cancel", "status", "status", "reset", "reset")
    rest = pick(*[rest] * 8, f"{rest} please", f"{rest} now", f"please {rest}")
    if rng.random() < 0.18:
        rest = pick("stop", "stop", "stop", "stop stop", "stop now", "please stop", "stop the valve", "robot stop")
    if rest.startswith(("half", "by", "confirm", "stop", "cancel")) and rng.random() < 0.7:
        return rest
    return pick(f"robot, {rest}", f"robot, {rest}", f"robot {rest}", f"{rest}", "robot" if rng.random() < 0.3 else rest)


def jumble(rng: np.random.Generator) -> str:
    """Words of ours in any order, so that no order is learnt."""
    return " ".join(rng.choice(WORDS, rng.integers(1, 6)))


def near_miss(rng: np.random.Generator) -> str:
    """Words of ours among words that sound like them."""
    words = list(rng.choice(CONFUSABLE, rng.integers(1, 5)))
    for _ in range(rng.integers(0, 3)):
        words.insert(rng.integers(len(words) + 1), str(rng.choice(WORDS)))
    if rng.random() < 0.35:
        words[:0] = ["robot"] if rng.random() < 0.5 else ["robot", str(rng.choice(("open", "close")))]
    return " ".join(words)


def chatter(rng: np.random.Generator) -> str:
    """Common words in any order."""
    return " ".join(rng.choice(COMMON, rng.integers(3, 14)))
