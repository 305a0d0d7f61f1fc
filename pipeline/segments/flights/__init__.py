"""Flights: their slow errors, what repeats in them, and the residual wrench that they show."""
