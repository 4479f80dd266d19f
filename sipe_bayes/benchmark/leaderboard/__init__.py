"""The leaderboard: versioned tasks, entries that anybody may write, and their scores on one page."""
