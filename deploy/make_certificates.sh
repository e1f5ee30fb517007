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
if [[ ! $days =~ ^[1-9][0-9]{0,4}$ ]]; then
    echo "make_certificates.sh: error: DAYS=$days is no number of days from 1 to 99999" >&2
    exit 2
fi
byte='(25[0-5]|2[0-4][0-9]|1[0-9][0-9]|[1-9]?[0-9])'
for given in "$@"; do
    if [[ ! $given =~ ^[A-Za-z0-9_][A-Za-z0-9._-]*(,[A-Za-z0-9.:_-]+)*$ || $given == ca || $given == ca,* ]]; then
        echo "make_certificates.sh: error: '$given' is no NAME[,HOST...]" >&2
        exit 2
    fi
    IFS=, read -r name hosts <<< "$given"
    if ((${#name} > 64)); then
        echo "make_certificates.sh: error: '$name' is longer than a certificate's name may be: 64 letters" >&2
        exit 2
    fi
    for host in ${hosts//,/ }; do
        if [[ $host =~ ^[0-9.]+$ && ! $host =~ ^$byte(\.$byte){3}$ ]]; then
            echo "make_certificates.sh: error: '$host' is no IPv4 address: four numbers from 0 to 255" >&2
            exit 2
        fi
        if [[ $host == *:* && ! $host =~ ^[0-9A-Fa-f]*(:[0-9A-Fa-f]*){2,7}$ ]]; then
            echo "make_certificates.sh: error: '$host' is no IPv6 address, and a host goes without a port" >&2
            exit 2
        fi
    done
done
if ! command -v openssl > /dev/null; then
    echo "make_certificates.sh: error: no openssl found: install it" >&2
    exit 1
fi
mkdir -p "$folder"
cd "$folder"

if [[ -e ca.pem && ! -e ca.key ]]; then
    # A new authority would be none for the certificates that this one has signed.
    echo "make_certificates.sh: error: ca.pem is here without ca.key: bring it back, or take another folder" >&2
    exit 2
fi
work=$(mktemp -d .new.XXXXXX)  # in the same folder: each file is whole once it has its name
trap 'rm -rf "$work"' EXIT

quietly() {  # openssl talks where all is well too
    local said
    if ! said=$("$@" 2>&1); then
        echo "make_certificates.sh: error: $1 $2 failed: $said" >&2
        exit 1
    fi
}

new_key() { quietly openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out "$work/key"; }

if [[ ! -e ca.pem ]]; then
    # A key that is there is kept: a run that was killed between the two is gone on with.
    key=ca.key
    [[ -e ca.key ]] || { new_key; key=$work/key; }
    quietly openssl req -x509 -new -key "$key" -sha256 -days "$((days * 4))" -subj "/CN=prism_edge lab" \
        -out "$work/pem" -addext basicConstraints=critical,CA:TRUE,pathlen:0 \
        -addext keyUsage=critical,keyCertSign,cRLSign
    [[ -e ca.key ]] || mv "$key" ca.key
    mv "$work/pem" ca.pem
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
    new_key
    quietly openssl req -new -key "$work/key" -subj "/CN=$name" -out "$work/csr"
    printf '%s\n' "subjectAltName=$alternatives" basicConstraints=critical,CA:FALSE \
        keyUsage=critical,digitalSignature extendedKeyUsage=serverAuth,clientAuth > "$work/ext"
    quietly openssl x509 -req -in "$work/csr" -CA ca.pem -CAkey ca.key -CAcreateserial -days "$days" -sha256 \
        -extfile "$work/ext" -out "$work/pem"
    chmod 644 "$work/pem"
    mv "$work/key" "$name.key"
    mv "$work/pem" "$name.pem"
    echo "made $name.pem and $name.key ($alternatives)"
done
