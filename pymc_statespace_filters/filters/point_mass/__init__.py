"""The density of one state on a grid."""
