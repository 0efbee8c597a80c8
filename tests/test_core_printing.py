"""Lines for a terminal that takes none for a while."""

from threading import Event
from time import monotonic

from barsight.core.printing import printed_aside


def test_a_terminal_that_takes_no_lines_holds_nobody_up() -> None:
    """The lines that wait come in order once it does; those beyond a thousand are dropped."""
    taken: list[str] = []
    may_go_on = Event()

    def slow(line: str) -> None:
        may_go_on.wait(10)
        taken.append(line)

    began = monotonic()
    with printed_aside(slow) as tell:
        for number in range(5000):
            tell(str(number))
        assert monotonic() - began < 1.0 and not taken
        may_go_on.set()
    assert taken[:1000] == [str(number) for number in range(1000)] and len(taken) <= 1001


def test_lines_told_last_are_printed_before_the_end() -> None:
    """A pipe that is closed ends the lines, not who tells them."""
    taken: list[str] = []
    with printed_aside(taken.append) as tell:
        tell("last")
    assert taken == ["last"]

    def closed(line: str) -> None:
        raise BrokenPipeError

    with printed_aside(closed) as tell:
        tell("nobody reads")
