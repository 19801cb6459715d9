"""What the checkpoint saves the planner."""

import streamlit as st

from dashboards.data import chosen, comparisons, figures
from relevance.report.style import DASH, TIMES

choice = chosen()
table, whole, notes = comparisons(choice) if choice.checkpoint else ([], [], [])
for note in notes:
    st.warning(note)
if not table:
    st.info("The planner was not rerun with a checkpoint yet: `relevance evaluate` does.")
    st.stop()
shown = []
for c in (c for c in whole if c.beta == 0 and c.n_solvable):
    spread = f"{c.speedup.low:.2f} to {c.speedup.high:.2f}; " if c.speedup.n else ""
    value = f"{c.speedup.value:.2f}{TIMES}" if c.speedup.n else DASH
    shown.append(
        (f"{c.guide}, {c.search} search", value, f"{spread}{c.misses} of {c.n_solvable} missed")
    )
if shown:
    figures(*shown, columns=2)
st.dataframe(
    table,
    hide_index=True,
    column_config={
        name: st.column_config.NumberColumn(title, format=format)
        for name, title, format in (
            ("seconds_unguided", "unguided, s", "%.4f"),
            ("seconds_guided", "guided, s", "%.4f"),
            ("seconds_network", "network, s", "%.4f"),
            ("speedup", "speed-up", "%.2f"),
            ("speedup_both", "speed-up, misses left out", "%.2f"),
            ("nlps_unguided", "NLPs unguided", "%.1f"),
            ("nlps_guided", "NLPs guided", "%.1f"),
        )
    },
)
st.caption(
    "CPU seconds a solvable task, network and fallbacks included; a missed task costs the "
    "guided attempt and then the unguided run. Intervals: 67% confidence."
)
