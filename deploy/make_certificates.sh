#!/bin/bash
# Makes a lab's certificates: an authority, and one certificate for each robot, operator or remote process.
#   deploy/make_certificates.sh FOLDER NAME[,HOST...]...
# NAME is what a certificate says it is (network.operators, network.remote); HOST what others connect to: a
# host name or an address. What is there already is kept, so that names can be added later.
set -euo pipefail
umask 077

days=${DAYS:-825}
usage="usage: deploy/make_certificates.sh FOLDER NAME[,HOST...]...   (DAYS=825: how long they hold)"
if [[ ${1-} == -h || ${1-} == --help ]]; then
    echo "$usage"
    exit 0
fi
if (($# < 2)); then
    echo "$usage" >&2
    exit 2
fi
folder=$1
shift
for given in "$@"; do
    if [[ ! $given =~ ^[A-Za-z0-9_-][A-Za-z0-9._-]*(,[A-Za-z0-9.:_-]+)*$ || $given == ca || $given == ca,* ]]; then
        echo "make_certificates.sh: error: '$given' is no NAME[,HOST...]" >&2
        exit 2
    fi
done
mkdir -p "$folder"
cd "$folder"

new_key() { openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out "$1" 2> /dev/null; }

if [[ -e ca.pem && ! -e ca.key ]]; then
    # A new authority would be none for the certificates that this one has signed.
    echo "make_certificates.sh: error: ca.pem is here without ca.key: bring it back, or take another folder" >&2
    exit 2
fi
if [[ ! -e ca.pem ]]; then
    # Each file is whole once it has its name, and a key is kept: an interrupted run is gone on with.
    [[ -e ca.key ]] || { new_key .ca.key; mv .ca.key ca.key; }
    openssl req -x509 -new -key ca.key -sha256 -days "$((days * 4))" -subj "/CN=prism_edge lab" -out .ca.pem \
        -addext basicConstraints=critical,CA:TRUE,pathlen:0 -addext keyUsage=critical,keyCertSign,cRLSign
    mv .ca.pem ca.pem
    echo "made ca.pem, the authority; keep ca.key off the robots"
fi
chmod 644 ca.pem  # certificates are public, and a copy keeps this: the service is a user of its own
for given in "$@"; do
    IFS=, read -r name hosts <<< "$given"
    [[ ! -e $name.pem ]] || { echo "kept $name.pem"; continue; }
    alternatives=DNS:$name
    for host in ${hosts//,/ }; do
        if [[ $host =~ ^[0-9.]+$ || $host == *:* ]]; then alternatives+=,IP:$host; else alternatives+=,DNS:$host; fi
    done
    new_key "$name.key"
    openssl req -new -key "$name.key" -subj "/CN=$name" -out ".$name.csr"
    printf '%s\n' "subjectAltName=$alternatives" basicConstraints=critical,CA:FALSE \
        keyUsage=critical,digitalSignature extendedKeyUsage=serverAuth,clientAuth > ".$name.ext"
    openssl x509 -req -in ".$name.csr" -CA ca.pem -CAkey ca.key -CAcreateserial -days "$days" -sha256 \
        -extfile ".$name.ext" -out ".$name.pem" 2> /dev/null
    chmod 644 ".$name.pem"
    mv ".$name.pem" "$name.pem"
    rm -f ".$name.csr" ".$name.ext"
    echo "made $name.pem and $name.key ($alternatives)"
done
