-- The figures at the top of the page, over all splits.
SELECT
    (SELECT count(*) FROM scenes) AS scenes,
    (SELECT count(*) FROM plans) AS goals,
    (SELECT avg(CASE WHEN status = 'solved' THEN 1.0 ELSE 0.0 END) FROM plans) AS solved,
    (SELECT count(*) FROM plans WHERE replay_ok IS NOT NULL) AS replayed,
    (SELECT avg(CASE WHEN replay_ok THEN 1.0 ELSE 0.0 END) FROM plans WHERE replay_ok IS NOT NULL)
        AS replay_ok,
    (SELECT count(*) FROM timings) AS timed,
    (SELECT median(seconds) FROM timings) AS median_seconds;
