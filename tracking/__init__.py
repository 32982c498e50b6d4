"""The multi-view model-based tracker."""
