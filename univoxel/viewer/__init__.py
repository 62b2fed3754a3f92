"""A run in a browser, path traced while hands move the camera and the light."""
