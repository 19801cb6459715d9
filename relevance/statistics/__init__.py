"""What a dataset holds and whether it keeps its contracts: tables, a card, and `check`."""

from relevance.statistics.cards import card, write_card
from relevance.statistics.contracts import PER_RULE, Breach, check, rules
from relevance.statistics.tables import VIEWS, Statistics, Table, cell, statistics

__all__ = [
    "PER_RULE",
    "VIEWS",
    "Breach",
    "Statistics",
    "Table",
    "card",
    "cell",
    "check",
    "rules",
    "statistics",
    "write_card",
]
