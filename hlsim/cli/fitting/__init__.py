"""Commands about the gains of an aid that is fitted to an ear."""
