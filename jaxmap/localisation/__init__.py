"""Poses of a wheeled rover from GPS, gyros, inclinometer and wheels, smoothed over a whole recording."""
