-- Share of relevant objects among the queries. Variables: splits, families (all when not set).
SELECT
    family, predicate,
    sum(plans)::BIGINT AS plans,
    sum(queries)::BIGINT AS queries,
    sum(relevant)::BIGINT AS relevant,
    sum(relevant) / nullif(sum(queries), 0) AS relevant_share,
    sum(ambiguous_share * queries) / nullif(sum(queries), 0) AS ambiguous_share
FROM label_balance
WHERE list_contains(coalesce(getvariable('splits'), ['train', 'validation', 'test']), split)
    AND list_contains(coalesce(getvariable('families'), [family]), family)
GROUP BY family, predicate
ORDER BY family, predicate;
