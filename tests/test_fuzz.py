"""Some of the fuzzer's cases for every reader; `make fuzz` runs thousands."""

from fuzz import FAILING, GOOD, OUTCOMES, READERS, Worker, run

CASES = 16  # of each reader, on every change of the code: half a minute for all


def test_damaged_files_are_refused_in_one_line_or_read(capsys):
    counts = run(list(READERS), CASES)
    assert len(counts) >= 14
    assert not {outcome for count in counts.values() for outcome in count} - set(GOOD), (
        capsys.readouterr().out
    )


def test_the_fuzzer_sees_every_bad_outcome():
    assert {*GOOD, *FAILING} == set(OUTCOMES)
    worker = Worker(seconds=4.0)
    try:
        assert {name: worker.ask(name, 1)[0] for name in FAILING} == {
            name: name for name in FAILING
        }
    finally:
        worker.close()
