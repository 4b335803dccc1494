"""Shipping: ONNX export with parity, golden cases, verification, documents made by code."""
