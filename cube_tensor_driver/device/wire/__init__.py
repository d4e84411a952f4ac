"""The wire protocol: conversion of bytes to frames and of frames to bytes, without any I/O."""
