-- Label distribution of one split: a row a family and predicate, and one that sums a family.
SELECT family, predicate, goals, solved, plans, queries, relevant, relevant_share
FROM paper_label_distribution
WHERE split = $split AND n_actions = 'all'
ORDER BY family, predicate <> 'all', predicate;
