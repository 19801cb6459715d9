-- Label distribution of one split: a row a predicate, a family sums its own.
SELECT predicate, goals, solved, plans, queries, relevant, relevant_share
FROM paper_label_distribution
WHERE split = $split AND n_actions = 'all'
ORDER BY predicate IN (SELECT predicate FROM plans), predicate;
