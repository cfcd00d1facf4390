"""People in pictures: landmarks and masks by small networks, triangulation (extra `vision`)."""
