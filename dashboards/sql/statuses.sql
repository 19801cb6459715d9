-- How planning ended, as far as it happened.
SELECT DISTINCT status FROM plans ORDER BY status = 'solved' DESC, status;
