"""Some of the fuzzer's cases for every reader; `make fuzz` runs thousands."""

import pytest
from fuzz import GOOD, OUTCOMES, READERS, Worker, run

CASES = 16  # of each reader, on every change of the code: half a minute for all


def test_damaged_files_are_refused_in_one_line_or_read(capsys):
    counts = run(list(READERS), CASES)
    assert len(counts) >= 14
    assert not {outcome for count in counts.values() for outcome in count} - set(GOOD), (
        capsys.readouterr().out
    )


@pytest.mark.parametrize("outcome", [o for o in OUTCOMES if o not in GOOD])
def test_the_fuzzer_sees_every_bad_outcome(outcome):
    """The worker is one whose reader fails in that way."""
    worker = Worker(seconds=5.0, failing=outcome)
    assert worker.ask("hdr", 1)[0] == outcome
    worker.close()
