"""Pictures and films for people: contact sheets, comparisons, video that plays in a browser."""
