"""Tests of scenes in every form."""
