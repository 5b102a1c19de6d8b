"""From sightings to the parameters of each mirror, with their covariance."""
