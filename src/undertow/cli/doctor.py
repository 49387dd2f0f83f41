"""What is installed, what could be added, how punctual this machine is, and a test of it all."""

from __future__ import annotations

from undertow.base import table
from undertow.cli.terminal import command, exit_unless, progress_bar, show


@command("undertow doctor", "undertow doctor --no-test")
def doctor(test: bool = True) -> None:
    """Report what is installed and what each extra would add, and test that it works here.

    Exit status 1 when a test fails.

    Parameters
    ----------
    test
        Run the self-test, ten seconds.
    """
    from undertow.studies.doctor import extras, facts_of_machine, self_test

    show(table(("", ""), facts_of_machine().items(), left=("",), show_header=False))
    rows = [
        (
            extra.name,
            "yes" if not extra.missing else "no",
            extra.adds,
            ", ".join(f"{name} {version}" for name, version in extra.packages if version)
            if not extra.missing
            else f"pip install 'undertow[{extra.name}]'",
        )
        for extra in extras()
    ]
    show(table(("extra", "here", "adds", "packages, or how to get it"), rows,
               left=("here", "adds", "packages, or how to get it")))  # fmt: skip
    if not test:
        return
    show("\nSelf-test: ten seconds, or a minute where all has to be compiled first")
    passed, warnings = True, []
    with progress_bar() as progress:
        for result in self_test(progress):
            passed &= result.passed
            warnings += [result.warning] * bool(result.warning)
            mark = "ok  " if result.passed else "FAIL"
            show(f"{mark} {result.name} ({result.seconds:.1f} s): {result.words}")
    if not passed:
        show("Something is wrong: see FAIL above.")
    else:
        show(f"All tests pass, but {'; '.join(warnings)}." if warnings else "All is well.")
    exit_unless(passed)
