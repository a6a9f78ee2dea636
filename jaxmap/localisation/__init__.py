"""Where a wheeled rover was: its poses from GPS, gyros, inclinometer and wheels, smoothed over a whole recording."""
