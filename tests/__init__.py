"""Tests of nexwarp."""
