"""Settings of the command line, made before anything compiles; figures below the table of times."""

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_enable_async_dispatch", False)


def pytest_terminal_summary(terminalreporter, config):
    """One line for each benchmark that left figures of its own."""
    session = getattr(config, "_benchmarksession", None)
    for bench in session.benchmarks if session else ():
        if bench.extra_info:
            told = ", ".join(f"{name}: {_short(value)}" for name, value in bench.extra_info.items())
            terminalreporter.write_line(f"{bench.name}: {told}")


def _short(value):
    return f"{value:.3g}" if isinstance(value, float) else str(value)
