"""Options of XLA for programs that take long to compile; each states what was measured for it."""

QUICK_COMPILE = {"xla_backend_optimization_level": 1, "xla_cpu_prefer_vector_width": 512}
"""On a CPU, a training step: a third less time to compile at equal speed (18.1 to 12.5 s, 74 and
76 ms per step), and the processor's full vector width, of which XLA uses half by default."""

LOOP_EMITTERS = {"xla_cpu_use_fusion_emitters": False}
"""On a CPU, the filter along recorded runs: its programs compile in half the time and run as fast
(`diagnose` of five minutes of data on one core: 179 to 130 s the first time, 73 and 61 s with its
programs in the cache). A training step compiles faster too but takes an eighth longer."""
