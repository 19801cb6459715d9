-- Label distribution of one split: a row a predicate, `same-plane` sums its four.
SELECT predicate, goals, solved, plans, queries, relevant, relevant_share
FROM paper_label_distribution
WHERE split = $split AND n_actions = 'all'
ORDER BY predicate <> 'same-plane', predicate = 'on', predicate;
