-- Goals of one split that made no labels, by reason.
SELECT status, reason, sum(goals)::BIGINT AS goals
FROM plan_failures
WHERE split = $split
GROUP BY status, reason
ORDER BY goals DESC, status, reason;
